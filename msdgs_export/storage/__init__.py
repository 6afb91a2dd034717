"""Storage: arrays of a scene file in fewer bits than float32, as few as rendered frames allow.

Nodes of the graph unfold them. They read constants alone, so onnxruntime computes them once, when it makes a session.
"""

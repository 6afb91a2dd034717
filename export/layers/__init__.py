"""Each kind of deformation layer as part of an ONNX graph."""

"""Plans: ways to compute a scene's deformation in an ONNX graph. All keep the scene file's contract.

One module per plan. A graph of layers deforms all given ids at once. The reader (`msdgs_serve.deformation`) splits ids
into chunks, which run in parallel and keep memory independent of the scene's size. A graph of trajectories poses all
Gaussians.
"""

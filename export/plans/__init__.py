"""Plans: ways to compute a scene's deformation in an ONNX graph. All keep the contract `msdgs/1`.

One file a plan. A graph of layers deforms the ids that it is given in one go; the loop over chunks of ids, which keeps
memory independent of the scene's size, is in the reader (`msdgs_serve.deformation`), where the chunks also run side by
side. A graph of fitted trajectories blends those of all Gaussians and picks the ids.
"""

"""The dynamic Gaussian model: canonical Gaussians, layers and support composed, and the `model.pt` file."""

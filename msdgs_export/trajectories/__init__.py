"""Poses of the moving Gaussians over time: sampled from the layers, and splines fitted to them."""

"""Density control: strategies that add, remove and relocate Gaussians during training."""

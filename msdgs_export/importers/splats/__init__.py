"""Readers of files that hold one set of Gaussians, one module per format."""

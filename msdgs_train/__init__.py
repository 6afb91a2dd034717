"""Fit multi-step deformable 3D Gaussians to images of a moving scene (torch)."""

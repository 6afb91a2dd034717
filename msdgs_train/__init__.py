"""Fit multi-step deformable 3D Gaussians to photographs of a moving scene (torch)."""

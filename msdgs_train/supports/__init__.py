"""Supports: the points that deformation layers move, Gaussians themselves or control nodes that carry them."""

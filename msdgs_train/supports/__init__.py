"""What deformation layers move: the Gaussians themselves, or control nodes that carry them."""

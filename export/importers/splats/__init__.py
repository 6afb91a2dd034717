"""Files that hold one set of Gaussians, one module a format."""

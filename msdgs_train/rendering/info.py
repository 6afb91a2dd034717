"""What density control reads of a rendering."""

from torch import Tensor


class RasterizationInfo:
    """Radii and gradients of one rendering, for density control."""

    radii: Tensor
    """[N] larger half-extent of the footprint in pixels; 0 for Gaussians that are not drawn."""
    means2d_grads: Tensor | None = None
    """[N, 2] d loss / d projected mean, per pixel, or if asked for the sums over pixels of absolute values; None before
    the backward pass."""

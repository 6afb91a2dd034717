"""Projected Gaussians: the layout of their records."""

import math
from typing import NamedTuple

import numpy as np

from msdgs_serve.rasterizer.simd.types import NUM_LANES

RECORD = NUM_LANES
"""Numbers per splat record: one vector."""

# indices of the numbers in a record
(X, Y, ROOT_A, ROOT_B, ROOT_C, LOG2_OPACITY, RED, GREEN, BLUE, DEPTH, EXTENT_X, EXTENT_Y) = (
    np.uint64(place) for place in range(12)
)
ROOT_SCALE = math.sqrt(0.5 / math.log(2))
"""Factor on the root of the inverse covariance, so that alpha = 2^(LOG2_OPACITY - |root @ d|²)."""


class Splats(NamedTuple):
    """N projected Gaussians. One that isn't drawn has a record of zeros, or none at all if it was left out with its
    block, and any rectangle.

    A record holds the mean X, Y in pixels; the root [[A, B], [0, C]] of the inverse 2D covariance times `ROOT_SCALE`²,
    in 1/px; log2 of the opacity; the color seen from the camera, at least 0; the depth along the camera's axis in scene
    units; and half the size in pixels of the box outside of which alpha < alpha_min.
    """

    records: np.ndarray  # [N, RECORD]
    rectangles: np.ndarray  # [N, 4] uint16: tile columns [first, past), then tile rows [first, past), from `origin`
    keys: np.ndarray  # [N or more] uint64: for each drawn splat the bits of its float32 depth above its index
    drawn: np.ndarray  # [P, 2] start and stop of the ranges of `keys` that are filled, by index
    depth_range: tuple[int, int]  # bits of the smallest and the largest drawn depth
    origin: tuple[int, int]  # upper left corner of the first tile in the camera's image, pixels
    valid: bool  # whether all Gaussians pass `Gaussians.validate`; SH coefficients are checked if drawn

    @property
    def visible(self) -> int:
        """The number of splats that are drawn."""
        return sum(stop - start for start, stop in self.drawn.tolist())

    @property
    def extents(self) -> np.ndarray:
        """[N, 2] half the size of each footprint's box in pixels, 0 if the splat isn't drawn."""
        return self.records[:, EXTENT_X : EXTENT_Y + 1]

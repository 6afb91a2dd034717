"""Projected Gaussians: the layout of their records."""

import math
from typing import NamedTuple

import numpy as np

from msdgs_serve.rasterizer.vector_types import NUM_LANES

RECORD = NUM_LANES
"""Numbers that a splat's record has: one load. Their places:"""
(X, Y, ROOT_A, ROOT_B, ROOT_C, LOG2_OPACITY, RED, GREEN, BLUE, DEPTH, EXTENT_X, EXTENT_Y) = (
    np.uint64(place) for place in range(12)
)
ROOT_SCALE = math.sqrt(0.5 / math.log(2))
"""alpha = 2^(LOG2_OPACITY - |root @ d|²): the root is that of the inverse covariance times this."""
CACHE_LINE = 64
"""Bytes."""


class Splats(NamedTuple):
    """N projected Gaussians. Of one that isn't drawn the record is 0 and the rectangle empty.

    A record: the mean X, Y in pixels; the root [[A, B], [0, C]] of the inverse 2D covariance times `ROOT_SCALE`²,
    1/px; log2 of the opacity; the color seen from the camera, 0 or more; the depth along the camera's axis, scene
    units; half the size of the box outside of which alpha < alpha_min, pixels.
    """

    records: np.ndarray  # [N, RECORD]
    rectangles: np.ndarray  # [N, 4] uint16: columns and rows of tiles, each first and past the last
    keys: np.ndarray  # [N] uint64: bits of the float32 depth above the index of each splat that is drawn
    drawn: np.ndarray  # [P, 2] start and stop of the keys that there are, in the order of the indices
    depth_range: tuple[int, int]  # bits of the least and the largest depth of what is drawn
    valid: bool  # whether `Gaussians.validate` has nothing to say; harmonics of what isn't drawn are not looked at

    @property
    def visible(self) -> int:
        """The number of splats that are drawn."""
        return sum(stop - start for start, stop in self.drawn.tolist())

    @property
    def extents(self) -> np.ndarray:
        """[N, 2] half of the footprint's box in pixels, 0 where nothing is drawn."""
        return self.records[:, EXTENT_X : EXTENT_Y + 1]


def empty_records(count: int, dtype: np.dtype) -> np.ndarray:
    """[count, RECORD] from a multiple of 64 bytes on, so that a record of float32 is one cache line and not two."""
    size = count * RECORD * dtype.itemsize
    raw = np.empty(size + CACHE_LINE, np.uint8)
    start = -raw.ctypes.data % CACHE_LINE
    return raw[start : start + size].view(dtype).reshape(count, RECORD)

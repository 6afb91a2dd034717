"""An order of points in which neighbors in the list are neighbors in space."""

import numpy as np

GRID_BITS = 20
"""Bits per coordinate."""


def morton_order(points: np.ndarray) -> np.ndarray:
    """[N] int64 indices of points, [N, 3], along a Z-order curve through their bounding box; a stable sort."""
    low, high = points.min(axis=0, initial=np.inf), points.max(axis=0, initial=-np.inf)
    cells = (points.astype(np.float64) - low) / np.maximum(high - low, np.finfo(np.float32).tiny)
    codes = np.zeros(len(points), np.uint64)
    for axis, values in enumerate((cells * (2**GRID_BITS - 1)).astype(np.uint64).T):
        for bit in range(GRID_BITS):
            codes |= (values >> np.uint64(bit) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return np.argsort(codes, kind="stable")

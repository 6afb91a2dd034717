"""Bounds of Gaussians that don't move, so that those that a camera can't see need not be read.

Scene files order static Gaussians along a space-filling curve: consecutive ones are near each other.
"""

from typing import NamedTuple

import numpy as np

from msdgs_serve.scene.gaussians import FloatArray

BLOCK = 256
"""Gaussians per block."""


class StaticBounds(NamedTuple):
    """Bounds of B blocks of Gaussians whose means and scales don't change, for every camera and time."""

    first: int  # index of the first block; the Gaussians before it may move
    boxes: np.ndarray  # [B, 6] float64 centers and half sides of the boxes around the means, scene units
    sizes: np.ndarray  # [B] float64 largest standard deviation, scene units


def static_bounds(moving_count: int, means: FloatArray, scales: FloatArray) -> StaticBounds:
    """Return the bounds of static Gaussians, [S, 3] each, that follow `moving_count` others."""
    first = -(-moving_count // BLOCK)
    places = np.arange(first * BLOCK - moving_count, len(means), BLOCK)
    if not len(places):
        return StaticBounds(first, np.empty((0, 6)), np.empty(0))
    low, high = (each.reduceat(means, places).astype(np.float64) for each in (np.minimum, np.maximum))
    boxes = np.concatenate([(low + high) / 2, (high - low) / 2 * (1 + 1e-9)], axis=1)
    return StaticBounds(first, boxes, np.maximum.reduceat(scales.max(axis=1), places).astype(np.float64))

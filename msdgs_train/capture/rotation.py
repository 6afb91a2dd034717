"""Whether a camera only turned: how much of the motion in its pictures no rotation explains.

Poses of a camera that only turns look sound, as points at arbitrary depths fit its frames. So matches of pairs of
frames are compared with what the best rotation of a pinhole camera makes of them.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

WIDEST = 40
"""Pairs that are compared: those in which the picture moves most."""
FOCALS = np.geomspace(0.4, 3.0, 25)
"""Tried focal lengths, in longer sides of the picture."""
FINER = np.geomspace(0.93, 1.07, 9)
"""Tried multiples of the best of them."""
ROUNDS = 6
"""Of the reweighted fit of a rotation."""
NEAREST = 75.0
"""Percentile of the residuals of a pair: near points show the parallax that a far wall hides."""


class Pair(NamedTuple):
    """Matches of two frames of a camera, from the principal point in longer sides of the picture."""

    first: np.ndarray  # [N, 2]
    second: np.ndarray  # [N, 2]

    @property
    def shift(self) -> float:
        """Median displacement."""
        return float(np.median(np.linalg.norm(self.second - self.first, axis=1)))


def beyond_rotation(pairs: Sequence[Pair]) -> float:
    """Displacement that no rotation explains, in longer sides of the picture; 0 without pairs.

    It is the median over the widest pairs, with the focal length at which that is smallest.
    """
    widest = sorted(pairs, key=lambda pair: -pair.shift)[:WIDEST]
    if not widest:
        return 0.0
    coarse = [_unexplained(widest, focal) for focal in FOCALS]
    best = FOCALS[int(np.argmin(coarse))]
    return min(_unexplained(widest, best * factor) for factor in FINER)


def _unexplained(pairs: Sequence[Pair], focal: float) -> float:
    return float(np.median([rotation_residual(pair, focal) for pair in pairs]))


def rotation_residual(pair: Pair, focal: float) -> float:
    """Distance between points of the second frame and where the best rotation takes those of the first.

    The rotation is Kabsch's of the viewing directions, with Cauchy weights against what moves.
    """
    first, second = (_directions(points, focal) for points in pair)
    weights, residuals = np.ones(len(first)), np.zeros(len(first))
    for _ in range(ROUNDS):
        u, _, vt = np.linalg.svd((weights[:, None] * second).T @ first)
        turned = first @ (u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt).T
        residuals = np.linalg.norm(focal * turned[:, :2] / np.maximum(turned[:, 2:], 1e-6) - pair.second, axis=1)
        weights = 1 / (1 + (residuals / max(float(np.median(residuals)), 1e-9)) ** 2)
    return float(np.percentile(residuals, NEAREST))


def _directions(points: np.ndarray, focal: float) -> np.ndarray:
    directions = np.concatenate([points, np.full((len(points), 1), focal)], axis=1)
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)

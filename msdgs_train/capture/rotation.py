"""Whether a camera only turned: how much of the motion in its pictures no rotation explains.

Poses of a camera that only turns look sound, as points at arbitrary depths fit its frames. So the points' places in
pairs of frames are compared with what the best rotation makes of them.
"""

from itertools import combinations
from typing import NamedTuple

import numpy as np

from msdgs_train.capture.sparse_model import Summary

FRAMES = 16
"""Frames of a camera, evenly spaced, whose pairs are compared."""
SHARED = 30
"""Points that a pair of frames sees, for the pair to count."""
FOCALS = np.geomspace(0.5, 2.0, 13)
"""Tried focal lengths, as multiples of the model's: that of a camera which only turned may be wrong."""
ROUNDS = 6
"""Of the reweighted fit of a rotation."""
NEAREST = 75.0
"""Percentile of the residuals of a pair: near points show the parallax that a far wall hides."""
WIDEST = 90.0
"""Percentile over pairs: a few wide ones suffice for poses."""


class Pair(NamedTuple):
    """Where two frames see the same points, in pixels from the principal point."""

    first: np.ndarray  # [N, 2]
    second: np.ndarray  # [N, 2]
    focal: float  # pixels


def beyond_rotation(model: Summary, images: np.ndarray) -> float:
    """Displacement in pixels that no rotation explains, in the widest pairs of one camera's images; 0 without pairs.

    `images` are the camera's rows in the model, in the order of time.
    """
    chosen = images[np.unique(np.linspace(0, len(images) - 1, min(FRAMES, len(images))).astype(int))]
    pairs = [pair for one, other in combinations(chosen, 2) if (pair := _pair(model, one, other)) is not None]
    if not pairs:
        return 0.0
    residuals = np.array([[rotation_residual(pair, scale * pair.focal) for scale in FOCALS] for pair in pairs])
    return float(np.percentile(residuals, WIDEST, axis=0).min())


def rotation_residual(pair: Pair, focal: float) -> float:
    """Distance in pixels between points of the second frame and where the best rotation takes those of the first.

    The rotation is Kabsch's of the viewing directions, with Cauchy weights against what moves.
    """
    first, second = (_directions(points, focal) for points in pair[:2])
    weights, residuals = np.ones(len(first)), np.zeros(len(first))
    for _ in range(ROUNDS):
        u, _, vt = np.linalg.svd((weights[:, None] * second).T @ first)
        turned = first @ (u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt).T
        residuals = np.linalg.norm(focal * turned[:, :2] / np.maximum(turned[:, 2:], 1e-6) - pair.second, axis=1)
        weights = 1 / (1 + (residuals / max(float(np.median(residuals)), 1e-6)) ** 2)
    return float(np.percentile(residuals, NEAREST))


def _pair(model: Summary, one: int, other: int) -> Pair | None:
    image, point = model.observations.T
    shared = np.intersect1d(point[image == one], point[image == other])
    if len(shared) < SHARED:
        return None
    first, second = (_projected(model, row, model.points[shared]) for row in (one, other))
    return Pair(first, second, float(model.intrinsics[one, 0]))


def _projected(model: Summary, image: int, points: np.ndarray) -> np.ndarray:
    pose = model.camera_to_world[image]
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    return model.intrinsics[image, 0] * local[:, :2] / local[:, 2:]


def _directions(points: np.ndarray, focal: float) -> np.ndarray:
    directions = np.concatenate([points, np.full((len(points), 1), focal)], axis=1)
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)

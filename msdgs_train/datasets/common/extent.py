"""Scene size for datasets that don't state it, from the sparse points or else from the cameras."""

from collections.abc import Sequence

import numpy as np

from msdgs_serve.scene import Camera
from msdgs_train.datasets.common.normalization import find_subject

QUANTILE = 0.99


def scene_half_size(points: np.ndarray | None, cameras: Sequence[Camera]) -> float:
    """Return half the side of the cube around the origin with 99 % of the sparse `points`, [M, 3], in scene units.

    Without points, it holds a ball around what `cameras`, one or more, show, whose radius is their distance from it,
    1 if nothing tells.
    """
    if points is not None and len(points):
        return float(np.quantile(np.abs(points).max(axis=1), QUANTILE)) or 1.0
    center, distance, _ = find_subject(cameras, None)
    return float(np.abs(center).max()) + (distance or 1.0)

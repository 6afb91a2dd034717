"""Scene size for datasets that don't state it, from the sparse points or else from the cameras."""

from collections.abc import Sequence

import numpy as np

from msdgs_serve.scene import Camera
from msdgs_train.datasets.common.normalization import find_subject

QUANTILE = 0.99


def scene_half_size(points: np.ndarray | None, cameras: Sequence[Camera]) -> float:
    """Return half the side of the cube around the origin with 99 % of the sparse `points`, [M, 3], in scene units.

    Without points, it holds a ball around what `cameras`, one or more, show, whose radius is their distance from it.
    """
    if points is not None and len(points):
        reach = float(np.quantile(np.abs(points).max(axis=1), QUANTILE))
    else:
        center, distance, _ = find_subject(cameras, None)
        reach = float(np.abs(center).max() + distance)
    return reach if reach > 0 else 1.0

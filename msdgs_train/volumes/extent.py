"""How far from its cameras a scene is."""

from typing import TYPE_CHECKING

import numpy as np

from msdgs_serve.scene import Camera

if TYPE_CHECKING:
    from msdgs_train.datasets import SceneData

NOMINAL = 2.0, 6.0
"""Of D-NeRF's scenes, whose cameras are about 4 from what they show."""
OUTLIERS = 0.01
"""Fraction of the sparse points before the nearest, and behind the farthest, that count."""
MARGIN = 1.1
MIN_RATIO = 0.02
"""Of the nearest depth to the farthest."""


def depth_range(scene: "SceneData") -> tuple[float, float]:
    """Where rays begin and end, in scene units, so that they hold what the training images show: the sparse points in
    them, or else the ball around the cube that holds the scene. By depth and by distance along rays alike."""
    if scene.has_nominal_size:
        return NOMINAL
    cameras = [frame.camera for frame in scene.splits["train"]]
    seen = np.zeros((0, 2))
    if scene.points is not None:
        seen = np.concatenate([_seen(camera, scene.points) for camera in cameras])
    if len(seen):
        depths, distances = seen.T  # a point's depth is the smaller of both
        near, far = np.quantile(depths, OUTLIERS) / MARGIN, np.quantile(distances, 1 - OUTLIERS) * MARGIN
    else:
        radius = 3**0.5 * scene.scene_half_size
        distances = [np.linalg.norm(camera.position) for camera in cameras]
        near, far = min(distances) - radius, max(distances) + radius
    return max(float(near), MIN_RATIO * float(far)), float(far)


def _seen(camera: Camera, points: np.ndarray) -> np.ndarray:
    """[M, 2] depths and distances of the points that an image shows."""
    depths = camera.visible_depths(points)
    return np.column_stack([depths, np.linalg.norm(points - camera.position, axis=1)])[depths > 0]

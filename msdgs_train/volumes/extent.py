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
    """Depths, in scene units, between which the training images show the scene: those of the sparse points in them, or
    else of the ball around the cube that holds it."""
    if scene.has_nominal_size:
        return NOMINAL
    cameras = [frame.camera for frame in scene.splits["train"]]
    depths = np.zeros(0)
    if scene.points is not None:
        depths = np.concatenate([_depths_in_image(camera, scene.points) for camera in cameras])
    if len(depths):
        near, far = np.quantile(depths, [OUTLIERS, 1 - OUTLIERS]) * (1 / MARGIN, MARGIN)
    else:
        radius = 3**0.5 * scene.scene_half_size
        distances = [np.linalg.norm(camera.position) for camera in cameras]
        near, far = min(distances) - radius, max(distances) + radius
    return max(float(near), MIN_RATIO * float(far)), float(far)


def _depths_in_image(camera: Camera, points: np.ndarray) -> np.ndarray:
    pixels, depths = camera.project(points)
    inside = ((pixels >= 0) & (pixels < (camera.width, camera.height))).all(axis=1)
    return depths[inside & (depths > 0)]

"""How a scene is seen where nothing is said of it: from its cameras, or its bounds."""

import math
from dataclasses import dataclass

import numpy as np

from msdgs_serve.scene.baked import SceneMetadata

DEFAULT_SIZE = 512
DEFAULT_FOV_Y = 50.0


@dataclass(frozen=True)
class Framing:
    """What a camera needs and a request may leave out."""

    target: np.ndarray  # [3] the middle of the scene
    distance: float  # from there, to see all
    up: np.ndarray  # [3] unit
    fov_y: float  # degrees
    width: int
    height: int


def framing(metadata: SceneMetadata) -> Framing:
    """From the scene's cameras, or its bounds where it has none (then z is up)."""
    low, high = np.asarray(metadata.bounds, dtype=np.float64)
    target = (low + high) / 2
    if not metadata.cameras:
        radius = max(float(np.linalg.norm(high - low)) / 2, 1e-3)
        distance = radius / math.sin(math.radians(DEFAULT_FOV_Y) / 2)
        return Framing(target, distance, np.array([0.0, 0.0, 1.0]), DEFAULT_FOV_Y, DEFAULT_SIZE, DEFAULT_SIZE)
    poses = np.array([each.camera.camera_to_world for each in metadata.cameras])
    distance = float(np.median(np.linalg.norm(poses[:, :3, 3] - target, axis=1)))
    first = metadata.cameras[0].camera
    fov_y = math.degrees(2 * math.atan(first.height / (2 * first.fy)))
    return Framing(target, max(distance, 1e-3), _up(poses), fov_y, first.width, first.height)


def _up(poses: np.ndarray) -> np.ndarray:
    """The mean of the up directions of cameras, [N, 4, 4]; the world axis that is near it, where one is."""
    mean = -poses[:, :3, 1].mean(axis=0)
    length = float(np.linalg.norm(mean))
    if length < 1e-3:
        return np.array([0.0, 0.0, 1.0])
    mean = mean / length
    axis = int(np.argmax(np.abs(mean)))
    if abs(mean[axis]) > 0.8:
        return np.sign(mean[axis]) * np.eye(3)[axis]
    return mean

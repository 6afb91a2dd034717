"""Ways in which people move a camera, as poses around the synthetic scene: camera to world, OpenCV axes."""

import math

import numpy as np

from msdgs_serve.scene.camera import orbit

TARGET = np.array([0.0, 0.3, 0.0])
UP = np.array([0.0, 0.0, 1.0])
DISTANCE, AZIMUTH, ELEVATION = 2.35, -90.0, 17.0


def arc(degrees: float, frames: int) -> list[np.ndarray]:
    """A camera that walks on an arc around the scene and looks at it; `degrees` as the scene's middle sees it."""
    return [_orbit(AZIMUTH + part) for part in degrees * _parts(frames)]


def pan(degrees: float, frames: int) -> list[np.ndarray]:
    """A camera that turns on the spot."""
    poses = []
    for angle in np.radians(degrees * _parts(frames)):
        pose = _orbit(AZIMUTH)
        turn = np.array([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]])
        pose[:3, :3] = turn @ pose[:3, :3]
        poses.append(pose)
    return poses


def tripod(frames: int) -> list[np.ndarray]:
    """A camera that stands still."""
    return [_orbit(AZIMUTH)] * frames


def _orbit(azimuth: float) -> np.ndarray:
    return orbit(TARGET, DISTANCE, float(azimuth), ELEVATION, UP)


def _parts(frames: int) -> np.ndarray:
    return np.linspace(-0.5, 0.5, frames)

"""Time range and initial camera of a viewer."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from msdgs_serve.scene import Camera
from msdgs_serve.scene.camera import orbit
from msdgs_serve.scene.metadata import SceneCamera
from msdgs_train.datasets import SceneData
from msdgs_train.gaussians.model_file import LoadedModel

DEFAULT_FOV = 50.0  # degrees, vertical


class SceneView(NamedTuple):
    """Time range, number of layers and initial camera. World axes, scene units."""

    time_range: tuple[float, float]
    layers: int  # K
    eye: np.ndarray  # [3]
    target: np.ndarray  # [3] on the optical axis; the camera orbits around it
    up: np.ndarray  # [3] unit
    fov_y: float  # radians


def view_of_data(scene: SceneData, layers: int) -> SceneView:
    """Return the view of the camera of the first training image."""
    middle = np.zeros(3) if scene.points is None or not len(scene.points) else np.median(scene.points, axis=0)
    cameras = [frame.camera for frame in scene.splits["train"]]
    return _seen_by(cameras, middle, scene.time_range, layers)


def view_of_file(loaded: LoadedModel) -> SceneView:
    """Return the view of the first camera in the model, or one from the side with z up if it has none."""
    low, high = np.array(loaded.scene.bounds)
    cameras = [SceneCamera.from_plain(entry).camera for entry in loaded.scene.cameras]
    if not cameras:
        distance = max(float(np.linalg.norm(high - low)), 1e-3)
        pose = orbit((low + high) / 2, distance, 30.0, 20.0, np.array([0.0, 0.0, 1.0]))
        cameras = [Camera.from_fov(pose, 1, 1, DEFAULT_FOV)]
    return _seen_by(cameras, (low + high) / 2, loaded.scene.time_range, len(loaded.model.deformation))


def _seen_by(cameras: Sequence[Camera], middle: np.ndarray, time_range: tuple[float, float], layers: int) -> SceneView:
    """Return the view of the first camera; the target is the point of its optical axis nearest to `middle`, [3]."""
    first = cameras[0]
    forward = first.camera_to_world[:3, 2]
    ahead = float((middle - first.position) @ forward)
    distance = ahead if ahead > 0 else max(float(np.linalg.norm(middle - first.position)), 1e-3)
    up = -np.mean([camera.camera_to_world[:3, 1] for camera in cameras], axis=0)
    if np.linalg.norm(up) < 1e-3 or np.linalg.norm(np.cross(up, forward)) < 1e-3:
        up = -first.camera_to_world[:3, 1]
    up, fov_y = up / np.linalg.norm(up), 2 * math.atan(first.height / (2 * first.fy))
    return SceneView(time_range, layers, first.position, first.position + distance * forward, up, fov_y)

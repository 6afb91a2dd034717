"""Views at which errors are measured: cameras of training and viewer at times between those of the training images."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from msdgs_export.measure.times import times_to_verify
from msdgs_serve.scene.camera import Camera, orbit
from msdgs_serve.scene.metadata import SceneCamera, SceneMetadata
from msdgs_train.gaussians.bounds import first_by_pose
from msdgs_train.gaussians.model_file import SceneInfo

MIN_CAMERAS = 4
"""With fewer, cameras on a circle around the scene are added."""

ADDED_CAMERAS = 6
ADDED_SIZE, ADDED_FOV, ADDED_ELEVATION = 256, 40.0, 25.0
"""Pixels and degrees of an added camera if no camera is stored."""

GOLDEN = (math.sqrt(5) - 1) / 2


class View(NamedTuple):
    """One camera at one time."""

    camera: Camera
    t: float
    name: str


def cameras_of(info: SceneInfo, training: Sequence[Camera] = ()) -> list[tuple[str, Camera]]:
    """The cameras of a scene by name, one per pose: those of `training` if given, else all in the model; more are added
    if too few.

    Raises ValueError or KeyError for a stored camera that can't be used.
    """
    named = [(f"training {i}", camera) for i, camera in enumerate(training)]
    if not named:
        stored = [("training ", entry) for entry in info.training_cameras] + [("", entry) for entry in info.cameras]
        named = [(f"{prefix}{entry['name']}", SceneCamera.from_plain(entry).camera) for prefix, entry in stored]
    cameras = first_by_pose(named, lambda each: each[1])
    return cameras if len(cameras) >= MIN_CAMERAS else [*cameras, *_around(info, cameras)]


def cameras_of_file(metadata: SceneMetadata) -> list[tuple[str, Camera]]:
    """The cameras of a scene file by name; more are added if too few."""
    bounds = [list(corner) for corner in metadata.bounds]
    return cameras_of(SceneInfo(bounds=bounds, cameras=[camera.to_plain() for camera in metadata.cameras]))


def evaluation_views(
    cameras: Sequence[tuple[str, Camera]], time_range: tuple[float, float], times: int, cameras_per_time: int
) -> list[View]:
    """Views at `times` times, both ends and between frames, from other cameras at each time."""
    views = []
    for i, t in enumerate(dict.fromkeys(times_to_verify(*time_range, times))):
        chosen = {int((i * cameras_per_time + j) * GOLDEN % 1 * len(cameras)) for j in range(cameras_per_time)}
        views += [View(cameras[c][1], t, cameras[c][0]) for c in sorted(chosen)]
    return views


def selection_views(
    cameras: Sequence[tuple[str, Camera]], time_range: tuple[float, float], times: int, cameras_per_time: int = 1
) -> list[View]:
    """Views at evenly spread times; none of the times between the ends is one of `evaluation_views`."""
    spread = list(dict.fromkeys(float(t) for t in np.linspace(*time_range, times))) * cameras_per_time
    chosen = [int((i * GOLDEN + 0.5) % 1 * len(cameras)) for i in range(len(spread))]
    views = [View(cameras[c][1], t, cameras[c][0]) for c, t in zip(chosen, spread, strict=True)]
    return sorted(views, key=lambda view: view.t)


def _around(info: SceneInfo, cameras: Sequence[tuple[str, Camera]]) -> list[tuple[str, Camera]]:
    """Cameras on a circle around the scene that are like the first of `cameras`, if there is one."""
    low, high = np.array(info.bounds, float)
    center, reach = (low + high) / 2, max(float(np.linalg.norm(high - low)) / 2, 1e-6)
    like, distance = Camera.from_fov(np.eye(4), ADDED_SIZE, ADDED_SIZE, ADDED_FOV), 2.5 * reach
    up = np.array([0.0, 0.0, 1.0])
    if cameras:
        like = cameras[0][1]
        distance = max(float(np.linalg.norm(like.position - center)), 1e-3 * reach)
        up = -like.camera_to_world[:3, 1]
    elevations = (ADDED_ELEVATION if i % 2 else 0.0 for i in range(ADDED_CAMERAS))
    poses = [orbit(center, distance, 360 * i / ADDED_CAMERAS, e, up) for i, e in enumerate(elevations)]
    intrinsics = like.fx, like.fy, like.cx, like.cy, like.width, like.height
    return [(f"added {i}", Camera(*intrinsics, pose)) for i, pose in enumerate(poses)]

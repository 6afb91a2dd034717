"""The size of a scene, from its cameras and from its visible Gaussians."""

from collections.abc import Callable, Iterable, Sequence
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from msdgs_serve.scene import Camera
from msdgs_train.datasets import Frame
from msdgs_train.gaussians.model import PosedGaussians

T = TypeVar("T")

BOUNDS_TIMES = 9
VISIBLE_OPACITY = 0.05
OUTSIDE_BOUNDS = 0.01
"""Fraction of the means beyond the bounds on each side: some are far away, outside of all images."""


def scene_scale(cameras: Sequence[Camera]) -> float:
    """1.1 times the radius of the cameras' positions, as 3D Gaussian Splatting measures a scene; 0 for one camera."""
    positions = np.array([camera.position for camera in cameras])
    return 1.1 * float(np.linalg.norm(positions - positions.mean(axis=0), axis=1).max())


def first_by_pose(items: Iterable[T], camera: Callable[[T], Camera]) -> list[T]:
    """The first item of each camera pose, in their order: a video camera that stands still counts once."""
    found: dict[bytes, T] = {}
    for item in items:
        found.setdefault(camera(item).camera_to_world.tobytes(), item)
    return list(found.values())


def spread_frames(frames: Sequence[Frame], count: int) -> list[Frame]:
    """At most `count` frames, of different cameras that are far from each other, in their order; the first is among
    them."""
    distinct = first_by_pose(frames, lambda frame: frame.camera)
    positions = np.array([frame.camera.position for frame in distinct])
    chosen, distances = [0], np.full(len(distinct), np.inf)
    while len(chosen) < min(count, len(distinct)):
        distances = np.minimum(distances, np.linalg.norm(positions - positions[chosen[-1]], axis=1))
        distances[chosen] = -1.0
        chosen.append(int(distances.argmax()))
    return [distinct[i] for i in sorted(chosen)]


def views_of(points: np.ndarray, cameras: Sequence[Camera]) -> np.ndarray:
    """[N] number of the cameras that have each point, [N, 3], in their image."""
    counts = np.zeros(len(points), np.int64)
    for camera in cameras:
        counts += camera.visible_depths(points) > 0
    return counts


def pixel_sizes(points: Tensor, cameras: Sequence[Camera]) -> Tensor:
    """[N] width of a pixel at each point, [N, 3], in scene units, in the camera where it is smallest; whether that one
    shows the point isn't checked."""
    positions = points.new_tensor(np.array([camera.position for camera in cameras]))
    focal_lengths = points.new_tensor([max(camera.fx, camera.fy) for camera in cameras])
    return (torch.cdist(points, positions) / focal_lengths).amin(dim=1)


def scene_bounds(
    pose: Callable[[float], PosedGaussians], time_range: tuple[float, float], scene_half_size: float
) -> list[list[float]]:
    """Corners of the bounding box of the means of visible Gaussians, over the time range."""
    boxes = []
    for t in np.linspace(*time_range, BOUNDS_TIMES):
        posed = pose(float(t))
        means = posed.means[posed.opacities >= VISIBLE_OPACITY]
        if len(means):
            boxes.append(torch.quantile(means, means.new_tensor([OUTSIDE_BOUNDS, 1 - OUTSIDE_BOUNDS]), dim=0))
    if not boxes:
        return [[-scene_half_size] * 3, [scene_half_size] * 3]
    stacked = torch.stack(boxes)
    return [stacked[:, 0].amin(dim=0).tolist(), stacked[:, 1].amax(dim=0).tolist()]

"""The moving region of an image, since a static background hides errors of the motion.

The moving region of a frame consists of the pixels that show, at its time, something that moves during the scene:

- If cameras are fixed, it is determined from the images: the pixels with a channel that differs by more than
  `MIN_CHANGE` from its median over the images of the same camera.
- Otherwise it is determined from the models: the pixels with a channel that changes by more than `MIN_CHANGE` if the
  moving Gaussians are removed. A Gaussian moves, in the view of a frame, if the projections of its center at `TIMES`
  evenly spaced times span more than `MIN_TRAVEL` pixels in width or height; rotation and scaling alone don't count.
  With several models the region is the union of theirs, so that all are evaluated on the same pixels. Of volumes it is
  unknown.
"""

from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from msdgs_serve.rasterizer.view import GSPLAT
from msdgs_serve.scene import Camera
from msdgs_train.datasets import Frame, SceneData, composite
from msdgs_train.gaussians.model import PosedGaussians
from msdgs_train.gaussians.model_file import LoadedModel
from msdgs_train.gaussians.stored import StoredModel
from msdgs_train.rendering.rasterize import rasterize

MIN_CHANGE = 0.1  # as a fraction of the range of a channel
MIN_TRAVEL = 1.0  # pixels
TIMES = 9
FIXED_TIMES = 3  # a camera with images at this many times is fixed
MEDIAN_IMAGES = 25  # at most, evenly spaced


class MovingRegion(NamedTuple):
    """The source of the moving region, and a function that gives it for a frame, [H, W] bool."""

    source: Literal["images", "model", "none"]
    mask: Callable[[Frame], np.ndarray]


def moving_region(scene: SceneData, split: str, models: Sequence[StoredModel]) -> MovingRegion:
    """Determine the moving region, from the images if each camera of the split has images at `FIXED_TIMES` or more
    times in any split, otherwise from the models; it is empty if it is unknown."""
    groups: dict[bytes, list[Frame]] = defaultdict(list)
    for frame in (frame for frames in scene.splits.values() for frame in frames):
        groups[_identity(frame.camera)].append(frame)
    cameras = {_identity(frame.camera) for frame in scene.splits[split]}
    if all(len({frame.t for frame in groups[camera]}) >= FIXED_TIMES for camera in cameras):
        background = models[0].scene.background
        medians = {camera: _median(groups[camera], background) for camera in cameras}
        return MovingRegion(
            "images", lambda frame: _differs(composite(frame.load_rgba(), background), medians[_identity(frame.camera)])
        )
    made_of_gaussians = [loaded for loaded in models if isinstance(loaded, LoadedModel)]
    if len(made_of_gaussians) < len(models):
        return MovingRegion("none", lambda frame: np.zeros((frame.camera.height, frame.camera.width), bool))
    masks = [_model_region(loaded, scene.time_range) for loaded in made_of_gaussians]
    return MovingRegion("model", lambda frame: np.any([mask(frame) for mask in masks], 0))


def _model_region(loaded: LoadedModel, time_range: tuple[float, float]) -> Callable[[Frame], np.ndarray]:
    model, background = loaded.model, torch.tensor(loaded.scene.background)
    with torch.no_grad():
        centers = [model.pose(float(t)).means for t in np.linspace(*time_range, TIMES)]

    @torch.no_grad()
    def mask(frame: Frame) -> np.ndarray:
        static = ~travels(centers, frame.camera)
        posed = model.pose(frame.t)
        whole, without = (
            rasterize(*gaussians, frame.camera, background, model.rasterizer)[0].clamp(0, 1).numpy()
            for gaussians in (posed, PosedGaussians(*(tensor[static] for tensor in posed)))
        )
        return _differs(whole, without)

    return mask


def travels(centers: list[Tensor], camera: Camera) -> Tensor:
    """Return [N] bool, whether the projections of each center span more than `MIN_TRAVEL` pixels.

    `centers` has [N, 3] for each of several times; times at which a center is behind the camera are ignored.
    """
    world_to_camera = torch.from_numpy(camera.world_to_camera).float()
    focal, infinity = torch.tensor([camera.fx, camera.fy]), torch.tensor(torch.inf)
    lowest, highest = infinity, -infinity
    for means in centers:
        points = means @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]
        pixels = focal * points[:, :2] / points[:, 2:]
        in_front = points[:, 2:] > GSPLAT.near_plane
        lowest = torch.minimum(lowest, torch.where(in_front, pixels, infinity))
        highest = torch.maximum(highest, torch.where(in_front, pixels, -infinity))
    return (highest - lowest).amax(dim=1) > MIN_TRAVEL


def _median(frames: list[Frame], background: tuple[float, float, float]) -> np.ndarray:
    """Return the median, [H, W, 3], over the images of one camera."""
    in_time = sorted(frames, key=lambda frame: frame.t)
    places = np.linspace(0, len(in_time) - 1, min(len(in_time), MEDIAN_IMAGES)).round().astype(int)
    return np.median([composite(in_time[place].load_rgba(), background) for place in places], axis=0)


def _differs(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return np.abs(one - other).max(axis=-1) > MIN_CHANGE


def _identity(camera: Camera) -> bytes:
    """Return a key that is equal for cameras that agree to six decimals."""
    intrinsics = [camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height]
    return (np.concatenate([intrinsics, camera.camera_to_world.ravel()]).round(6) + 0.0).tobytes()

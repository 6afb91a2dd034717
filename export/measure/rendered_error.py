"""What an export changed, in rendered pixels: its frames against those of the exact network in float64."""

import copy
import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
import torch

from export.measure.views import View
from msdgs_serve.rasterizer import GSPLAT, RasterizerOptions, rasterize
from msdgs_serve.scene.camera import Camera
from msdgs_serve.scene.gaussians import FloatArray, Gaussians
from msdgs_train.evaluation.metrics import psnr_from_mse
from msdgs_train.gaussians.model import DynamicGaussians, PosedGaussians

MEMORY = 768e6
"""Bytes of exact frames and poses that are kept; with larger images fewer views are."""

POSE_BYTES = 52
"""Of a Gaussian at one time: its mean in float64, the rest in float32."""

Pose = Callable[[float], Gaussians]


class WorstFrame(NamedTuple):
    """Which frame is furthest off."""

    camera: str
    t: float


@dataclass(frozen=True)
class RenderedError:
    """How far frames are from exact ones. Images are compared as they are shown, cut to [0, 1]."""

    psnr_mean: float  # dB, mean over frames of their PSNR; at most 100
    psnr_worst: float  # dB, of the worst frame
    worst_frame: WorstFrame | None  # None where nothing was drawn
    worst_pixel: float  # largest difference of a channel, in [0, 1]
    position: float  # largest distance of a Gaussian that is left from where it belongs, scene units
    position_pixels: float  # the same in an image, of the Gaussians that lie within it
    frames: int

    def to_plain(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return asdict(self) | {"worst_frame": self.worst_frame and self.worst_frame._asdict()}


class ExactFrames:
    """Frames of the model in float64, deformation and rasterizer, computed once and compared with many times over."""

    def __init__(
        self,
        model: DynamicGaussians,
        views: Sequence[View],
        background: Sequence[float],
        on_frame: Callable[[], object] = lambda: None,
    ) -> None:
        self.background = background
        self.views = within_memory(views, len(model.gaussians))
        self._frames: list[FloatArray] = []
        self._poses: dict[float, Gaussians] = {}
        self._model = copy.deepcopy(model).double()
        for t, views_then in by_time(self.views):
            gaussians = self.pose(t)
            quats, scales = gaussians.quats.astype(np.float32), gaussians.scales.astype(np.float32)
            first = next(iter(self._poses.values()), gaussians)
            self._poses[t] = Gaussians(gaussians.means, quats, scales, first.opacities, first.sh)
            for view in views_then:
                self._frames.append(shown(gaussians, view.camera, background, model.rasterizer).astype(np.float32))
                on_frame()

    def pose(self, t: float) -> Gaussians:
        """All Gaussians of the model in float64."""
        return posed(self._model, t)

    def kept(self, t: float) -> Gaussians:
        """All Gaussians at one of the views' times; quaternions and scales rounded to float32."""
        return self._poses[t]

    def measure(
        self,
        pose: Pose,
        ids: np.ndarray,
        *,
        options: RasterizerOptions | None = None,
        every: int = 1,
    ) -> RenderedError:
        """The error of `pose`, whose rows are the model's Gaussians `ids`, over all views or every n-th of them.

        It is drawn with the model's own rasterizer options, or with others."""
        options = options or self._model.rasterizer
        psnrs: list[float] = []
        worst, worst_frame, worst_pixel, position, position_pixels = np.inf, None, 0.0, 0.0, 0.0
        chosen = list(zip(self.views, self._frames, strict=True))[::every]
        frames = {id(view): frame for view, frame in chosen}
        for t, views in by_time([view for view, _ in chosen]):
            gaussians = pose(t)
            exact_means = self._poses[t].means[ids]
            distances = np.linalg.norm(gaussians.means - exact_means, axis=1)
            position = max(position, float(distances.max(initial=0)))
            for view in views:
                difference = np.abs(shown(gaussians, view.camera, self.background, options) - frames[id(view)])
                psnrs.append(psnr_from_mse(float(np.mean(np.square(difference, dtype=np.float64)))))
                worst_pixel = max(worst_pixel, float(difference.max()))
                offsets = _pixel_distances(view.camera, gaussians.means, exact_means)
                position_pixels = max(position_pixels, float(offsets.max(initial=0)))
                if psnrs[-1] < worst:
                    worst, worst_frame = psnrs[-1], WorstFrame(view.name, t)
        return RenderedError(
            float(np.mean(psnrs)), min(psnrs), worst_frame, worst_pixel, position, position_pixels, len(psnrs)
        )


def by_time(views: Sequence[View]) -> Iterator[tuple[float, list[View]]]:
    """Views that follow each other at one time, together."""
    for t, group in itertools.groupby(views, key=lambda view: view.t):
        yield t, list(group)


def within_memory(views: Sequence[View], gaussians: int) -> list[View]:
    """As many of the views, evenly spread, as have room for their exact frames and poses."""
    sizes = [12 * view.camera.width * view.camera.height + POSE_BYTES * gaussians for view in views]
    count = min(len(views), max(2, int(MEMORY / (sum(sizes) / len(sizes)))))
    return [views[i] for i in np.linspace(0, len(views) - 1, count).round().astype(int)]


@torch.no_grad()
def posed(model: DynamicGaussians, t: float) -> Gaussians:
    """The model's Gaussians at `t` in its own precision."""
    return as_gaussians(model.pose(t))


def as_gaussians(pose: PosedGaussians) -> Gaussians:
    """The model's tensors as arrays."""
    return Gaussians(*(tensor.detach().numpy() for tensor in pose))


def shown(gaussians: Gaussians, camera: Camera, background: Sequence[float], options: RasterizerOptions) -> FloatArray:
    """[H, W, 3] the frame as an image shows it, in [0, 1]."""
    return np.clip(rasterize(gaussians, camera, background=background, options=options).rgb, 0, 1)


def _pixel_distances(camera: Camera, got: FloatArray, exact: FloatArray) -> FloatArray:
    """[M] how far apart two sets of points are in an image, of those that lie within it."""
    imaged, depths = _projected(camera, exact)
    inside = (depths > GSPLAT.near_plane) & (imaged >= 0).all(axis=1)
    inside &= (imaged < [camera.width, camera.height]).all(axis=1)
    return np.linalg.norm(_projected(camera, got[inside])[0] - imaged[inside], axis=1)


def _projected(camera: Camera, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pixels [M, 2] and depths [M]; points at the near plane and behind it are put there."""
    in_camera = points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    depths = in_camera[:, 2]
    plane = in_camera[:, :2] / np.maximum(depths, GSPLAT.near_plane)[:, None]
    return plane * [camera.fx, camera.fy] + [camera.cx, camera.cy], depths

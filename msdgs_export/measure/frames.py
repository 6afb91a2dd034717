"""Frames of Gaussians, differences of two frames, and projections of points."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from msdgs_export.bake import starting_cameras
from msdgs_export.measure.poses import usable_rows
from msdgs_export.measure.views import cameras_of
from msdgs_serve.rasterizer import GSPLAT, RasterizerOptions, rasterize
from msdgs_serve.scene.camera import Camera
from msdgs_serve.scene.gaussians import FloatArray, Gaussians
from msdgs_train.evaluation.metrics import psnr_from_mse
from msdgs_train.gaussians.model_file import SceneInfo

NEAR = GSPLAT.near_plane
MIN_OPACITY = GSPLAT.alpha_min
"""Gaussians of lower opacity are not drawn at all."""


class FrameDifference(NamedTuple):
    """Difference of a frame from its target; values in [0, 1]."""

    psnr: float  # dB, at most 100
    worst_pixel: float  # largest difference of a channel


def render(gaussians: Gaussians, camera: Camera, background: Sequence[float], options: RasterizerOptions) -> FloatArray:
    """[H, W, 3] the frame, clamped to [0, 1] as it is displayed."""
    return np.clip(rasterize(gaussians, camera, background=background, options=options).rgb, 0, 1)


def compare(frame: FloatArray, target: FloatArray) -> FrameDifference:
    """Compare two frames [H, W, 3]; subtracted in their own precision, squared and averaged in float64."""
    difference = np.abs(frame - target)
    mse = float(np.mean(np.square(difference, dtype=np.float64)))
    return FrameDifference(psnr_from_mse(mse), float(difference.max(initial=0)))


def project(points: FloatArray, camera: Camera) -> tuple[FloatArray, FloatArray]:
    """Pixels [N, 2] and depths [N] of points [N, 3], in float64. Closer points are projected at the near plane."""
    pose = camera.world_to_camera
    with np.errstate(invalid="ignore", over="ignore"):
        in_camera = points.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
        plane = in_camera[:, :2] / np.maximum(in_camera[:, 2], NEAR)[:, None]
        return plane * [camera.fx, camera.fy] + [camera.cx, camera.cy], in_camera[:, 2]


def in_frame(pixels: FloatArray, depths: FloatArray, camera: Camera) -> np.ndarray:
    """[N] whether a projected point is inside the image and beyond the near plane."""
    return (depths > NEAR) & ((pixels >= 0) & (pixels < [camera.width, camera.height])).all(axis=1)


class PoseRenderer:
    """Draws poses that may hold NaN or infinity from a scene's cameras."""

    def __init__(self, scene: SceneInfo, options: RasterizerOptions = GSPLAT) -> None:
        self.background, self._options = scene.background, options
        self.cameras = [c.camera for c in starting_cameras(scene)] or [cameras_of(scene)[0][1]]

    def draw(self, posed: Gaussians, camera: Camera, keep: np.ndarray | None = None) -> np.ndarray:
        """[H, W, 3] float64 in [0, 1], drawn in float32, of the Gaussians `keep`, [N] bool, or of all. Those without a
        finite pose are omitted."""
        usable = usable_rows(posed)
        usable[usable] &= np.abs(posed.means[usable]).max(axis=1, initial=0) < np.finfo(np.float32).max
        chosen = usable if keep is None else usable & keep
        gaussians = Gaussians(**{name: array[chosen].astype(np.float32) for name, array in vars(posed).items()})
        return render(gaussians, camera, self.background, self._options).astype(np.float64)

    def pixel_gaps(self, got: Gaussians, expected: Gaussians, camera: Camera) -> np.ndarray:
        """[N] distance of each projected mean in pixels; 0 if the Gaussian isn't drawn in either pose."""
        (pixels, depths), (moved, depths_too) = project(expected.means, camera), project(got.means, camera)
        seen, seen_too = in_frame(pixels, depths, camera), in_frame(moved, depths_too, camera)
        with np.errstate(invalid="ignore"):
            gaps = np.linalg.norm(pixels - moved, axis=1)
        lost = ~np.isfinite(gaps) | (seen != seen_too)
        most = math.hypot(camera.width, camera.height)
        gaps = np.where(lost, np.minimum(np.nan_to_num(gaps, nan=math.inf), most), gaps)
        return np.where((seen | seen_too) & (expected.opacities > MIN_OPACITY), gaps, 0.0)

    def hidden_by_near_plane(self, means: np.ndarray) -> bool:
        """Whether all means, [N, 3], in front of any of the cameras are nearer than the near plane."""
        depths = [project(means, camera)[1] for camera in self.cameras]
        in_front = [d[d > 0] for d in depths]
        return any(len(d) for d in in_front) and all((d <= NEAR).all() for d in in_front)

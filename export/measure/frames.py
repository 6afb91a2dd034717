"""What errors of the pose do to the image: pixels and decibels."""

import math
from dataclasses import dataclass

import numpy as np

from export.jobs.bake import starting_cameras
from export.measure.gap import PosedArrays, usable_rows
from msdgs_serve.rasterizer import GSPLAT, RasterizerOptions, rasterize
from msdgs_serve.scene import Camera, Gaussians
from msdgs_serve.scene.camera import orbit
from msdgs_train.evaluation.metrics import psnr_from_mse
from msdgs_train.gaussians.model_file import SceneInfo

NEAR = GSPLAT.near_plane
VISIBLE_OPACITY = GSPLAT.alpha_min
"""Fainter Gaussians are not drawn at all."""

FALLBACK_SIZE = 256
"""Width and height in pixels of the view of a scene that brings no camera."""


@dataclass(frozen=True)
class ImageGap:
    """Two images of the same moment, displayed values in [0, 1]."""

    psnr: float  # dB, at most 100
    worst_pixel: float  # largest difference of a channel


class View:
    """Draws poses of a scene's Gaussians, `PosedArrays`, from its cameras."""

    def __init__(self, scene: SceneInfo, options: RasterizerOptions = GSPLAT) -> None:
        self.background, self._options = scene.background, options
        self.cameras = views_of(scene)

    def draw(self, posed: PosedArrays, camera: Camera, keep: np.ndarray | None = None) -> np.ndarray:
        """[H, W, 3] in [0, 1], drawn in float32; of the Gaussians `keep`, [N] bool, where given. Those that have no
        finite pose are left out."""
        usable = usable_rows(posed)
        usable[usable] &= np.abs(posed["means"][usable]).max(axis=1, initial=0) < np.finfo(np.float32).max
        chosen = usable if keep is None else usable & keep
        gaussians = Gaussians(**{name: array[chosen].astype(np.float32) for name, array in posed.items()})
        return rasterize(gaussians, camera, background=self.background, options=self._options).rgb.clip(0, 1)

    def pixel_gaps(self, got: PosedArrays, expected: PosedArrays, camera: Camera) -> np.ndarray:
        """[N] distance of each projected mean in pixels; 0 where the Gaussian isn't drawn in either pose."""
        (places, seen), (others, seen_too) = (_project(p["means"], camera) for p in (expected, got))
        drawn = (seen | seen_too) & (expected["opacities"] > VISIBLE_OPACITY)
        with np.errstate(invalid="ignore"):
            gaps = np.linalg.norm(places - others, axis=1)
        lost = ~np.isfinite(gaps) | (seen != seen_too)
        gaps = np.where(
            lost, np.minimum(np.nan_to_num(gaps, nan=math.inf), math.hypot(camera.width, camera.height)), gaps
        )
        return np.where(drawn, gaps, 0.0)

    def hidden_by_near_plane(self, means: np.ndarray) -> bool:
        """Whether all that any of the cameras has in front of it, of means [N, 3], is nearer than the near plane."""
        depths = [_to_camera(means, camera)[:, 2] for camera in self.cameras]
        in_front = [d[d > 0] for d in depths]
        return any(len(d) for d in in_front) and all((d <= NEAR).all() for d in in_front)


def views_of(scene: SceneInfo) -> list[Camera]:
    """The cameras that the scene file will start from, or one that sees all of the scene's bounds."""
    cameras = [c.camera for c in starting_cameras(scene)]
    if cameras:
        return cameras
    low, high = np.array(scene.bounds)
    distance = 1.5 * max(float(np.linalg.norm(high - low)), 1e-30)
    pose = orbit((low + high) / 2, distance, 30.0, 20.0, np.array([0.0, 0.0, 1.0]))
    return [Camera.from_fov(pose, FALLBACK_SIZE, FALLBACK_SIZE, 40.0)]


def image_gap(got: np.ndarray, expected: np.ndarray) -> ImageGap:
    """Of two images [H, W, 3]."""
    difference = got.astype(np.float64) - expected
    return ImageGap(psnr_from_mse(float(np.square(difference).mean())), float(np.abs(difference).max(initial=0)))


def in_image(means: np.ndarray, camera: Camera) -> np.ndarray:
    """[N] whether a Gaussian's centre is inside of the image and beyond the near plane."""
    return _project(means, camera)[1]


def _to_camera(means: np.ndarray, camera: Camera) -> np.ndarray:
    pose = camera.world_to_camera
    return means.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]


def _project(means: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """[N, 2] pixels, and [N] whether that is inside of the image and beyond the near plane."""
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        points = _to_camera(means, camera)
        places = points[:, :2] / points[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
        inside = ((places >= 0) & (places <= [camera.width, camera.height])).all(axis=1)
        return places, inside & (points[:, 2] > NEAR)

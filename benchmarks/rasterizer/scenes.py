"""Scenes of the rasterizer's benchmarks: seeded ones with the footprint of a trained object, and splat files."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from msdgs_export.importers.splats.formats import read_splats
from msdgs_serve.scene import Camera, Gaussians

MEDIAN_SCALES = {10_000: 0.010, 100_000: 0.007, 300_000: 0.005, 1_000_000: 0.0035}
"""Median standard deviation by number of Gaussians, as a fraction of the object's diameter."""

CAMERA_ANGLE_X = 0.6911
DISTANCE = 4.0
SH_DEGREE = 3


class Case(NamedTuple):
    """One frame to draw."""

    name: str
    gaussians: Gaussians
    camera: Camera

    def title(self) -> str:
        return f"{self.name} {len(self.gaussians):,}"

    def size(self) -> str:
        return f"{self.camera.width}×{self.camera.height}"


def seeded_cases(counts: tuple[int, ...], sizes: tuple[str, ...], seed: int) -> list[Case]:
    """All numbers of Gaussians at all sizes, WIDTHxHEIGHT in pixels."""
    cameras = [object_camera(*map(int, size.split("x"))) for size in sizes]
    return [Case("seeded", scene, camera) for scene in (object_scene(n, seed) for n in counts) for camera in cameras]


def file_cases(files: tuple[Path, ...], width: int = 800, height: int = 800) -> list[Case]:
    """Splat files of any format that can be imported, each seen from outside."""
    scenes = [(path.name, read_splats(path).gaussians) for path in files]
    return [Case(name, gaussians, around(gaussians, width, height)) for name, gaussians in scenes]


def object_scene(count: int, seed: int = 0) -> Gaussians:
    """A bumpy shell of flat Gaussians, mostly opaque or nearly transparent, a tenth floating around it; float32."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    radii = 1 + 0.1 * np.sin(5 * directions).sum(axis=1) + rng.normal(0, 0.01, count)
    floaters = rng.random(count) < 0.1
    radii[floaters] = 1.3 * np.cbrt(rng.random(np.count_nonzero(floaters)))
    scales = np.exp(rng.normal(np.log(2 * median_scale(count)), 0.5, (count, 3)))
    scales[np.arange(count), rng.integers(0, 3, count)] *= 0.15
    is_transparent = rng.random(count) < 0.35
    opacities = np.where(is_transparent, rng.beta(1.2, 8, count), rng.beta(8, 1.2, count))
    sh = rng.normal(0, 0.04, (count, (SH_DEGREE + 1) ** 2, 3))
    sh[:, 0] = 1.2 * np.sin(4 * directions + [0, 1, 2]) + rng.normal(0, 0.15, (count, 3))
    quats = rng.normal(size=(count, 4))
    arrays = (directions * radii[:, None], quats / np.linalg.norm(quats, axis=1, keepdims=True), scales, opacities, sh)
    return Gaussians(*(np.ascontiguousarray(array, np.float32) for array in arrays))


def median_scale(count: int) -> float:
    """Interpolate `MEDIAN_SCALES` on logarithmic axes."""
    counts, scales = np.log(list(MEDIAN_SCALES)), np.log(list(MEDIAN_SCALES.values()))
    return float(np.exp(np.interp(np.log(count), counts, scales)))


def object_camera(width: int, height: int) -> Camera:
    """A camera at distance 4, 0.6 radians around the object and 0.4 above it, `CAMERA_ANGLE_X` wide."""
    eye = DISTANCE * np.array([np.sin(0.6) * np.cos(0.4), -np.sin(0.4), -np.cos(0.6) * np.cos(0.4)])
    focal = 0.5 * width / np.tan(0.5 * CAMERA_ANGLE_X)
    pose = Camera.from_look_at(eye, np.zeros(3), np.array([0.0, -1.0, 0.0]), width, height, 40.0).camera_to_world
    return Camera(focal, focal, width / 2, height / 2, width, height, pose)


def around(gaussians: Gaussians, width: int, height: int) -> Camera:
    """A camera that looks along +z, so far away that 90 % of the Gaussians are in an image `CAMERA_ANGLE_X` wide."""
    target = np.median(gaussians.means, axis=0).astype(float)
    radius = np.quantile(np.linalg.norm(gaussians.means - target, axis=1), 0.9)
    focal = 0.5 * width / np.tan(0.5 * CAMERA_ANGLE_X)
    pose = np.eye(4)
    pose[:3, 3] = target - [0, 0, radius / np.sin(0.5 * CAMERA_ANGLE_X)]
    return Camera(focal, focal, width / 2, height / 2, width, height, pose)

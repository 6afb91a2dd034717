"""Lens distortion by the Brown–Conrady model, coefficients as in OpenCV, COLMAP and nerfstudio, and its removal."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.ndimage import map_coordinates

from msdgs_serve.scene import Camera
from msdgs_train.datasets.common.readers import DatasetInvalid

FOLD_GRID = 33


class Distortion(NamedTuple):
    """Radial (`k`) and tangential (`p`) coefficients; they act on x / z and y / z in OpenCV camera axes."""

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0


def checked_distortion(distortion: Distortion, camera: Camera, file: Path, field: str) -> Distortion | None:
    """`distortion`, or None if all its coefficients are 0.

    Raises `DatasetInvalid` if two points of the pinhole image of `camera` map to the same point of the distorted image.
    No lens does so: the coefficients are wrong, or were fitted to a part of the image.
    """
    if not any(distortion):
        return None
    x = (np.linspace(0, camera.width, FOLD_GRID) - camera.cx) / camera.fx
    y = (np.linspace(0, camera.height, FOLD_GRID) - camera.cy) / camera.fy
    with np.errstate(all="ignore"):
        u, v = distorted(x[None, :], y[:, None], distortion)
        u_y, u_x = np.gradient(u, y, x)
        v_y, v_x = np.gradient(v, y, x)
        if not np.all(u_x * v_y - u_y * v_x > 0):
            raise DatasetInvalid(file, field, f"{distortion} maps two points to one: undistort the images first")
    return distortion


def undistort(rgba: np.ndarray, camera: Camera, distortion: Distortion) -> np.ndarray:
    """Resample an image to the pinhole `camera`: uint8 [H, W, 4], straight alpha, like `rgba`.

    `camera` has the intrinsics of the distorted image and its size, H×W. Pixels are interpolated bilinearly,
    colors weighted by alpha. Points outside of the image take the nearest pixel of its border.
    """
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    u, v = distorted(x[None, :], y[:, None], distortion)
    pixels = np.stack([camera.fy * v + camera.cy - 0.5, camera.fx * u + camera.cx - 0.5])
    weighted = rgba.astype(np.float64)
    weighted[..., :3] *= weighted[..., 3:]
    channels = [map_coordinates(weighted[..., i], pixels, order=1, mode="nearest") for i in range(4)]
    alpha = channels[3]
    colors = [channel / np.where(alpha > 0, alpha, 1) for channel in channels[:3]]
    return np.floor(np.stack([*colors, alpha], axis=-1) + 0.5).astype(np.uint8)


def distorted(x: np.ndarray, y: np.ndarray, distortion: Distortion) -> tuple[np.ndarray, np.ndarray]:
    """Distort the points (x, y) of the plane z = 1 in camera axes."""
    k1, k2, p1, p2, k3 = distortion
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return u, v

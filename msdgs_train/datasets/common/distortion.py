"""Lens distortion by the Brown–Conrady model, coefficients as in OpenCV, COLMAP and nerfstudio, and its removal."""

from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from msdgs_serve.rasterizer.jit import kernel
from msdgs_serve.scene import Camera
from msdgs_train.datasets.common.readers import DatasetInvalid

FOLD_GRID = 33
Intrinsics = tuple[float, float, float, float]
"""fx, fy, cx, cy, pixels."""


class Distortion(NamedTuple):
    """Radial (`k`) and tangential (`p`) coefficients; they act on x / z and y / z in OpenCV camera axes."""

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0


def checked_distortion(distortion: Distortion, camera: Camera, file: Path, field: str) -> Distortion | None:
    """Return `distortion`, or None if all its coefficients are 0.

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
    colors weighted by alpha. Points outside of the image, which `inside` tells, take the nearest pixel of its border.
    """
    result = np.empty_like(rgba)
    _resample(np.ascontiguousarray(rgba), (camera.fx, camera.fy, camera.cx, camera.cy), distortion, result)
    return result


def shows_outside(camera: Camera, distortion: Distortion) -> bool:
    """Whether pixels of the pinhole image lie outside of the distorted one. Those at its border do first."""
    return _shows_outside((camera.fx, camera.fy, camera.cx, camera.cy), camera.width, camera.height, distortion)


@lru_cache(maxsize=1 << 14)
def _shows_outside(intrinsics: Intrinsics, width: int, height: int, distortion: Distortion) -> bool:
    columns, rows = np.arange(width), np.arange(height)
    sides = (columns, 0), (columns, height - 1), (0, rows), (width - 1, rows)
    return not all(_is_inside(intrinsics, width, height, distortion, *side).all() for side in sides)


def inside(camera: Camera, distortion: Distortion) -> np.ndarray:
    """Which pixels of the pinhole image have their centers in the distorted image: bool [H, W]."""
    intrinsics = camera.fx, camera.fy, camera.cx, camera.cy
    rows, columns = np.arange(camera.height)[:, None], np.arange(camera.width)
    return _is_inside(intrinsics, camera.width, camera.height, distortion, columns, rows)


def _is_inside(
    intrinsics: Intrinsics, width: int, height: int, distortion: Distortion, columns: Any, rows: Any
) -> np.ndarray:
    fx, fy, cx, cy = intrinsics
    u, v = distorted((columns + 0.5 - cx) / fx, (rows + 0.5 - cy) / fy, distortion)
    x, y = fx * u + cx, fy * v + cy
    return (x >= 0) & (x <= width) & (y >= 0) & (y <= height)


def distorted(x: Any, y: Any, distortion: Distortion) -> tuple[Any, Any]:
    """Distort the points (x, y) of the plane z = 1 in camera axes; scalars or arrays."""
    k1, k2, p1, p2, k3 = distortion
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return u, v


_distorted = kernel(distorted)


@kernel
def _resample(source: np.ndarray, intrinsics: tuple, distortion: tuple, out: np.ndarray) -> None:
    fx, fy, cx, cy = intrinsics
    height, width, _ = source.shape
    xs, ys = np.empty(width), np.empty(width)
    for row in range(height):
        for column in range(np.uint64(width)):  # in vectors; in one loop with the interpolation twice as long
            x, y = _distorted((column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy, distortion)
            xs[column] = min(max(fx * x + cx - 0.5, 0.0), width - 1.0)
            ys[column] = min(max(fy * y + cy - 0.5, 0.0), height - 1.0)
        for column in range(np.uint64(width)):
            x, y = xs[column], ys[column]
            left, top = int(x), int(y)
            right, bottom = min(left + 1, width - 1), min(top + 1, height - 1)
            across, down = x - left, y - top
            a = (1 - across) * (1 - down) * source[top, left, 3]
            b = across * (1 - down) * source[top, right, 3]
            c = (1 - across) * down * source[bottom, left, 3]
            d = across * down * source[bottom, right, 3]
            alpha = a + b + c + d
            of_colors = 1 / alpha if alpha > 0 else 0.0
            for channel in range(3):
                color = a * source[top, left, channel] + b * source[top, right, channel]
                color += c * source[bottom, left, channel] + d * source[bottom, right, channel]
                out[row, column, channel] = int(color * of_colors + 0.5)
            out[row, column, 3] = int(alpha + 0.5)

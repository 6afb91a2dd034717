"""Lens distortion of points by the formulas of OpenCV's documentation, and images of dots."""

import math
from typing import NamedTuple

import numpy as np

from msdgs_train.datasets import Frame
from msdgs_train.datasets.common.distortion import distorted

SIGMA = 2.0  # of a dot, in pixels
WINDOW = 9


class Lens(NamedTuple):
    fx: float = 300.0
    fy: float = 310.0
    cx: float = 164.5
    cy: float = 117.0
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    width: int = 320
    height: int = 240

    def pixel(self, x: float, y: float, z: float) -> tuple[float, float]:
        """Of a point in OpenCV camera axes; the corner of the image is (0, 0)."""
        a, b = x / z, y / z
        r = math.sqrt(a**2 + b**2)
        radial = 1 + self.k1 * r**2 + self.k2 * r**4 + self.k3 * r**6
        a_lens = a * radial + 2 * self.p1 * a * b + self.p2 * (r**2 + 2 * a**2)
        b_lens = b * radial + self.p1 * (r**2 + 2 * b**2) + 2 * self.p2 * a * b
        return self.fx * a_lens + self.cx, self.fy * b_lens + self.cy

    def pixels(self, points: np.ndarray) -> np.ndarray:
        """[N, 2] of [N, 3] points in OpenCV camera axes."""
        return np.array([self.pixel(*point) for point in points])

    def pinhole(self) -> "Lens":
        return Lens(self.fx, self.fy, self.cx, self.cy, width=self.width, height=self.height)

    def grid(self) -> np.ndarray:
        """[12, 3] points in OpenCV camera axes that are spread over the image, each at another depth."""
        columns, rows = np.meshgrid(
            np.linspace(0.125, 0.875, 4) * self.width, np.linspace(0.125, 0.875, 3) * self.height
        )
        depths = np.linspace(2.0, 6.0, columns.size)
        x, y = (columns.ravel() - self.cx) / self.fx, (rows.ravel() - self.cy) / self.fy
        return np.stack([x, y, np.ones_like(x)], axis=1) * depths[:, None]


def frame_pixels(frame: Frame, points: np.ndarray) -> np.ndarray:
    """[N, 2] pixels of [N, 3] world points in the stored image of a frame that isn't downscaled."""
    camera, local = frame.camera, points @ frame.camera.world_to_camera[:3, :3].T
    x, y, z = (local + frame.camera.world_to_camera[:3, 3]).T
    x, y = x / z, y / z
    if frame.distortion is not None:
        x, y = distorted(x, y, frame.distortion)
    return np.stack([camera.fx * x + camera.cx, camera.fy * y + camera.cy], axis=1)


def image_of_dots(pixels: np.ndarray, width: int, height: int) -> np.ndarray:
    """Uint8 [H, W, 4], opaque, black, with a white Gaussian dot at each of [N, 2] pixels."""
    x, y = np.arange(width) + 0.5, np.arange(height) + 0.5
    light = np.zeros((height, width))
    for u, v in pixels:
        light += np.exp(-((x[None, :] - u) ** 2 + (y[:, None] - v) ** 2) / (2 * SIGMA**2))
    rgba = np.full((height, width, 4), 255, np.uint8)
    rgba[..., :3] = np.round(255 * np.minimum(light, 1))[..., None]
    return rgba


def centroids(rgba: np.ndarray, near: np.ndarray) -> np.ndarray:
    """[N, 2] centroids of the brightness in a window around each of [N, 2] pixels."""
    found = []
    for u, v in near:
        left, top = int(u) - WINDOW, int(v) - WINDOW
        light = rgba[top : top + 2 * WINDOW + 1, left : left + 2 * WINDOW + 1, 0].astype(float)
        rows, columns = np.indices(light.shape) + 0.5
        found.append(((light * columns).sum() / light.sum() + left, (light * rows).sum() / light.sum() + top))
    return np.array(found)

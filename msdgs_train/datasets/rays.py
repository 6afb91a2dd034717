"""Rays through pixels, and batches of them from all images alike."""

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from msdgs_serve.scene import Camera
from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.datasets.common.scene_data import Frame

MAX_BYTES = 8 << 30
"""Of the pixels of all training images, which are in memory."""


class Rays(NamedTuple):
    """Rays through pixel centers, in scene units."""

    origins: Tensor  # [R, 3]
    directions: Tensor  # [R, 3], one unit of depth along the camera's axis
    times: Tensor  # [R] in [0, 1]

    def split(self, size: int) -> list["Rays"]:
        """The same rays in parts of `size` or fewer."""
        return [Rays(*part) for part in zip(*(tensor.split(size) for tensor in self), strict=True)]


class RayBatch(NamedTuple):
    """Rays and what their pixels show."""

    rays: Rays
    rgba: Tensor  # [R, 4] uint8, sRGB with straight alpha


def rays_of(camera: Camera, t: float, device: str = "cpu") -> Rays:
    """The rays of all pixels of a pinhole camera, row by row."""
    places = torch.arange(camera.width * camera.height, device=device)
    views = _Views.of([(camera, t)], device)
    return views.rays(torch.zeros_like(places), places)


class RayBatches:
    """Shuffled passes over the pixels of all images. A batch is determined by its number and the seed, so that a
    resumed run has the same ones."""

    def __init__(
        self, frames: Sequence[Frame], size: int, device: str, hits: Callable[[Rays], Tensor] | None = None
    ) -> None:
        """Reads all images.

        Args:
            size: rays of a batch; those that remain at the end of a pass are left out of it.
            hits: which rays take part, [R] bool; masked pixels never do.

        Raises `InvalidInput` if the images don't fit in memory or fewer than `size` rays are left.
        """
        pixels = sum(frame.camera.width * frame.camera.height for frame in frames)
        if 4 * pixels > MAX_BYTES:
            expected = f"a width of images at which all of them have {MAX_BYTES // 4:,} pixels or fewer"
            raise InvalidInput("size", expected, f"{pixels:,}")
        self._views = _Views.of([(frame.camera, frame.t) for frame in frames], device)
        chosen = [_pixels(frame, device, hits) for frame in frames]
        self._places = torch.cat([places for places, _ in chosen])
        self._rgba = torch.cat([rgba for _, rgba in chosen])
        self._ends = torch.tensor([len(places) for places, _ in chosen], device=device).cumsum(0)
        if len(self._places) < size:
            raise InvalidInput("config.rays", f"{len(self._places):,} or fewer, as the images have", size)
        self._size = size
        self.images_per_batch = size * len(frames) / pixels
        self._order = lru_cache(maxsize=1)(self._shuffled)

    def batch(self, number: int, seed: int) -> RayBatch:
        """Batch `number`, counted from 0."""
        each_pass = len(self._places) // self._size
        order = self._order(number // each_pass, seed)
        first = number % each_pass * self._size
        chosen = order[first : first + self._size].to(torch.int64)
        views = torch.searchsorted(self._ends, chosen, right=True)
        return RayBatch(self._views.rays(views, self._places[chosen]), self._rgba[chosen])

    def _shuffled(self, number: int, seed: int) -> Tensor:
        order = np.random.default_rng((seed, number)).permutation(np.arange(len(self._places), dtype=np.int32))
        return torch.from_numpy(order).to(self._places.device)


def _pixels(frame: Frame, device: str, hits: Callable[[Rays], Tensor] | None) -> tuple[Tensor, Tensor]:
    """Indices, [P], and colors, [P, 4], of the pixels of an image that take part."""
    rgba = torch.from_numpy(frame.load_rgba().reshape(-1, 4)).to(device)
    mask = frame.load_mask()
    counts = torch.ones(len(rgba), dtype=torch.bool, device=device)
    if mask is not None:
        counts &= torch.from_numpy(mask.reshape(-1)).to(device)
    if hits is not None:
        counts &= hits(rays_of(frame.camera, frame.t, device))
    places = torch.nonzero(counts)[:, 0]
    return places.to(torch.int32), rgba[places]


class _Views(NamedTuple):
    """Cameras and times of images."""

    focal: Tensor  # [V, 2] pixels
    center: Tensor  # [V, 2] principal points, pixels
    widths: Tensor  # [V] int64, pixels
    poses: Tensor  # [V, 3, 4] camera to scene
    times: Tensor  # [V]

    @classmethod
    def of(cls, views: Sequence[tuple[Camera, float]], device: str) -> "_Views":
        cameras = [camera for camera, _ in views]
        return cls(
            torch.tensor([[c.fx, c.fy] for c in cameras], device=device),
            torch.tensor([[c.cx, c.cy] for c in cameras], device=device),
            torch.tensor([c.width for c in cameras], device=device),
            torch.tensor(np.array([c.camera_to_world[:3] for c in cameras]), dtype=torch.float32, device=device),
            torch.tensor([t for _, t in views], device=device),
        )

    def rays(self, views: Tensor, places: Tensor) -> Rays:
        """Rays through pixels of views, [R] int64, by their index in the image, row by row, [R]."""
        widths, poses = self.widths[views], self.poses[views]
        pixels = torch.stack([places % widths, places // widths], dim=1) + 0.5
        plane = (pixels - self.center[views]) / self.focal[views]
        directions = torch.einsum("rij,rj->ri", poses[:, :, :2], plane) + poses[:, :, 2]
        return Rays(poses[:, :, 3], directions, self.times[views])

"""Training images as uint8 on the device of a run, and what a step compares its rendering with."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import mse_loss

from msdgs_train.datasets import Frame, composite
from msdgs_train.datasets.cache import ImageCache
from msdgs_train.layers import arrays
from msdgs_train.layers.arrays import to_device


class ImageFacts(NamedTuple):
    """What is the same in all steps of an image, computed once."""

    shows_all: bool
    """The border is transparent around what the image shows, so that nothing of the scene is outside it; an empty image
    may have all of it outside. Masked pixels may show anything."""
    is_opaque: bool

    @classmethod
    def of(cls, rgba: np.ndarray, mask: np.ndarray | None = None) -> "ImageFacts":
        """Of an image, [H, W, 4] uint8, and its mask, [H, W] bool."""
        a = rgba[..., 3] if mask is None else np.where(mask, rgba[..., 3], 255)
        border = (a[0], a[-1], a[:, 0], a[:, -1])
        return cls(bool(a.any()) and not any(side.any() for side in border), bool((rgba[..., 3] == 255).all()))


class TrainingImage(NamedTuple):
    """An image on the run's device."""

    rgba: Tensor  # [H, W, 4] uint8, sRGB with straight alpha
    mask: Tensor | None  # [H, W] bool, true where pixels count; None: all do
    facts: ImageFacts


class TrainingImages:
    """The images of a run. Up to `max_bytes` of them stay on its device, others are copied there whenever they are
    drawn, without waiting for it; 0 on a CPU, where the cache of decoded images has them."""

    def __init__(self, decoded: ImageCache, device: str, max_bytes: float) -> None:
        self._decoded, self._device, self._free = decoded, device, max_bytes
        self._facts: dict[tuple[Path, int], ImageFacts] = {}
        self._resident: dict[tuple[Path, int], TrainingImage] = {}

    def image(self, frame: Frame, *, is_halved: bool) -> TrainingImage:
        """The image of `frame`, or of `frame.halved()`."""
        key = (frame.image_path, frame.halved().camera.width if is_halved else frame.camera.width)
        if key in self._resident:
            return self._resident[key]
        d = self._decoded
        rgba, mask = (d.half_rgba(frame), d.half_mask(frame)) if is_halved else (d.rgba(frame), d.mask(frame))
        facts = self._facts.get(key)
        if facts is None:
            facts = self._facts[key] = ImageFacts.of(rgba, mask)
        pixels = to_device(torch.from_numpy(rgba), self._device)
        counts = None if mask is None else to_device(torch.from_numpy(mask), self._device)
        image = TrainingImage(pixels, counts, facts)
        size = rgba.nbytes + (0 if mask is None else mask.nbytes)
        if size <= self._free:
            self._free -= size
            self._resident[key] = image
        return image


class Target(NamedTuple):
    """A training image, or pixels of rays, over the background of a step, on the run's device."""

    rgb: Tensor  # [H, W, 3] or [R, 3] in [0, 1], over the background
    alpha: Tensor  # [H, W] or [R] uint8
    mask: Tensor | None = None  # [H, W] bool, true where pixels count; None: all do
    facts: ImageFacts = ImageFacts(shows_all=False, is_opaque=False)

    @classmethod
    def over(cls, image: TrainingImage, background: Tensor) -> "Target":
        """An image over a background color, [3]."""
        rgba = image.rgba
        if arrays.has_kernels(rgba):
            rgb = torch.from_numpy(composite(rgba.numpy(), background.numpy()))
        else:
            color, alpha = (rgba * (1 / 255)).split((3, 1), dim=2)
            rgb = background + alpha * (color - background)
        return cls(rgb, rgba[..., 3], image.mask, image.facts)

    @classmethod
    def of_pixels(cls, rgba: Tensor, background: Tensor) -> "Target":
        """Pixels of rays, [R, 4] uint8 with straight alpha, over a background color, [3]."""
        color, alpha = (rgba * (1 / 255)).split((3, 1), dim=1)
        return cls(background + alpha * (color - background), rgba[:, 3])

    def alpha_error(self, alpha: Tensor) -> Tensor:
        """Mean absolute difference of a rendering's alpha, [H, W] in [0, 1], over the pixels that count, or 0 if the
        image is opaque."""
        if self.facts.is_opaque:
            return alpha.new_zeros(())
        error = (alpha - self.alpha * (1 / 255)).abs()
        return error.mean() if self.mask is None else (error * self.mask).sum() / self.mask.sum().clamp(min=1)

    def squared_error(self, rgb: Tensor) -> Tensor:
        """Mean squared difference of a rendering, [H, W, 3], over channels and the pixels that count; a scalar."""
        if self.mask is None:
            return mse_loss(rgb.detach(), self.rgb)
        error = (rgb.detach() - self.rgb).square()
        return torch.where(self.mask, error.mean(dim=2), 0.0).sum() / self.mask.sum().clamp(min=1)

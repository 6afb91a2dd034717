"""A cache of decoded images and masks."""

import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import cast

import numpy as np
import torch
from torch import Tensor

from msdgs_train.datasets import Frame, composite

CHANNELS = 4


class ImageCache:
    """Keeps decoded images as uint8 RGBA, and masks as bool, up to `max_bytes`; others are read whenever they are asked
    for."""

    def __init__(self, max_bytes: float = math.inf) -> None:
        self._max_bytes = max_bytes
        self._pixels: dict[tuple[Path, int, bool], np.ndarray] = {}
        self._bytes = 0

    def image(self, frame: Frame, background: Tensor) -> Tensor:
        """Return the image of a frame, [H, W, 3] in [0, 1], over a background color, [3]."""
        return torch.from_numpy(composite(self.rgba(frame), background.numpy()))

    def rgba(self, frame: Frame) -> np.ndarray:
        """Return the image of a frame, [H, W, 4] uint8, sRGB with straight alpha."""
        return self._kept(frame, frame.load_rgba)

    def half_rgba(self, frame: Frame) -> np.ndarray:
        """Return the image of `frame.halved()`, downscaled from that of the frame, so that a file is read once."""
        half = frame.halved()
        return self._kept(half, lambda: half.downscale(self.rgba(frame)))

    def mask(self, frame: Frame) -> np.ndarray | None:
        """Return which pixels of the image count, [H, W] bool; None if all do."""
        if not frame.is_masked:
            return None
        return self._kept(frame, lambda: cast(np.ndarray, frame.load_mask()), is_mask=True)

    def half_mask(self, frame: Frame) -> np.ndarray | None:
        """Return the mask of `frame.halved()`, downscaled from that of the frame."""
        mask, half = self.mask(frame), frame.halved()
        return None if mask is None else self._kept(half, lambda: half.downscale_mask(mask), is_mask=True)

    def _kept(self, frame: Frame, read: Callable[[], np.ndarray], *, is_mask: bool = False) -> np.ndarray:
        key = (frame.image_path, frame.camera.width, is_mask)
        pixels = self._pixels.get(key)
        if pixels is None:
            pixels = read()
            if self._bytes + pixels.nbytes <= self._max_bytes:
                self._pixels[key] = pixels
                self._bytes += pixels.nbytes
        return pixels


def bytes_of(frames: Iterable[Frame]) -> int:
    """What images and masks of these frames take once they are decoded."""
    return sum(frame.camera.width * frame.camera.height * (CHANNELS + frame.is_masked) for frame in frames)

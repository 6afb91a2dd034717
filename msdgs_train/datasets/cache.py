"""A cache of decoded images."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from msdgs_train.datasets import Frame, composite

MAX_BYTES = 2 << 30


class ImageCache:
    """Keeps decoded images as uint8 RGBA, up to `MAX_BYTES`."""

    def __init__(self) -> None:
        self._pixels: dict[tuple[Path, int], np.ndarray] = {}
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

    def _kept(self, frame: Frame, read: Callable[[], np.ndarray]) -> np.ndarray:
        key = (frame.image_path, frame.camera.width)
        rgba = self._pixels.get(key)
        if rgba is None:
            rgba = read()
            if self._bytes + rgba.nbytes <= MAX_BYTES:
                self._pixels[key] = rgba
                self._bytes += rgba.nbytes
        return rgba

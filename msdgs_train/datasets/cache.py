"""A cache of decoded images."""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from msdgs_train.datasets import Frame, composite

MAX_BYTES = 2 << 30


class ImageCache:
    """Keeps decoded images as uint8 RGBA, up to `MAX_BYTES`."""

    def __init__(self) -> None:
        self._pixels: dict[Path, np.ndarray] = {}

    def image(self, frame: Frame, background: Tensor) -> Tensor:
        """Return the image of a frame, [H, W, 3] in [0, 1], over a background color, [3]."""
        return torch.from_numpy(composite(self._rgba(frame), background.numpy()))

    def transparency(self, frame: Frame) -> Tensor:
        """Return 1 − alpha of the image of a frame, [H, W] in [0, 1]."""
        return torch.from_numpy(1 - self._rgba(frame)[:, :, 3].astype(np.float32) / 255)

    def _rgba(self, frame: Frame) -> np.ndarray:
        rgba = self._pixels.get(frame.image_path)
        if rgba is None:
            rgba = frame.load_rgba()
            if (len(self._pixels) + 1) * rgba.nbytes <= MAX_BYTES:
                self._pixels[frame.image_path] = rgba
        return rgba

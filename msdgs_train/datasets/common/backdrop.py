"""The plain backdrop of opaque images: a color that most pixels at their borders have."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np

Color = tuple[float, float, float]

IMAGES = 8
"""Images that are looked at: each may be in a video of its own, which is decoded for it."""
TOLERANCE = 4
"""Of 255, between the backdrop and pixels that show it. Real walls vary more, and need Gaussians: as background they
would be missing in depth and alpha."""


class Image(Protocol):
    """What is read of a `Frame`."""

    def load_rgba(self) -> np.ndarray: ...
    def load_own_mask(self) -> np.ndarray | None: ...


def find_backdrop(frames: Sequence[Image]) -> Color | None:
    """Return the color, RGB in [0, 1], that more than half of the pixels at the borders of some of the frames have;
    None if there is none, if masks hide half of these pixels, or if an image is transparent somewhere."""
    shown, pixels = [], 0
    for index in sorted({round(k) for k in np.linspace(0, len(frames) - 1, IMAGES)}):
        rgba = frames[index].load_rgba()
        if rgba[..., 3].min() < 255:
            return None
        is_border = np.full(rgba.shape[:2], True)
        is_border[1:-1, 1:-1] = False
        mask = frames[index].load_own_mask()
        shown.append(rgba[is_border if mask is None else is_border & mask, :3])
        pixels += np.count_nonzero(is_border)
    colors = np.concatenate(shown).astype(float)
    if 2 * len(colors) <= pixels:
        return None
    color = np.median(colors, axis=0)
    is_plain = 2 * np.count_nonzero(np.abs(colors - color).max(axis=1) <= TOLERANCE) > pixels
    red, green, blue = (color / 255).tolist()
    return (red, green, blue) if is_plain else None

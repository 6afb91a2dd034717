"""What frames are chosen from: the pictures of a video or of a folder, one after the other."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np


class Picture(NamedTuple):
    """One frame of a video, or one image of a folder."""

    index: int  # in the video or folder
    time: float  # seconds after the first
    grey: np.ndarray  # uint8 [H, W], of the size that is written
    srgb: Callable[[], np.ndarray]  # uint8 [H, W, 3]


class Source(Protocol):
    """A video or a folder of images."""

    file: Path
    width: int  # pixels of what is written, as it is shown
    height: int
    count: int  # frames by the file's header or packets
    duration: float  # seconds between the first and last frame
    period: float  # seconds between frames, on average

    def pictures(self) -> Iterator[Picture]:
        """Yield all pictures in the order of their times. Raises `CaptureFailed`."""
        ...

    def notes(self) -> list[str]:
        """What people should know of it, known when all pictures are read; each a sentence."""
        ...


def fitted(width: float, height: float, size: int) -> tuple[int, int]:
    """Width and height in pixels with a long side of at most `size`."""
    scale = min(1.0, size / max(width, height))
    return max(1, round(width * scale)), max(1, round(height * scale))

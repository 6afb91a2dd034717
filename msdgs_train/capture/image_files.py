"""PNG files of a capture, read and written with OpenCV, which stores pixels only."""

from pathlib import Path

import cv2
import numpy as np

from msdgs_serve.writing import replacing
from msdgs_train.capture.errors import CaptureFailed


def read_color(file: Path) -> np.ndarray:
    """[H, W, 3] uint8, BGR. Raises `CaptureFailed`."""
    return _read(file, cv2.IMREAD_COLOR)


def read_gray(file: Path) -> np.ndarray:
    """[H, W] uint8. Raises `CaptureFailed`."""
    return _read(file, cv2.IMREAD_GRAYSCALE)


def write_image(file: Path, pixels: np.ndarray) -> None:
    """Write [H, W] or [H, W, 3], BGR, and the folders it needs. Raises `WriteFailed`."""
    file.parent.mkdir(parents=True, exist_ok=True)
    encoded = cv2.imencode(file.suffix, pixels)[1]
    with replacing(file) as temporary:
        temporary.write_bytes(encoded.tobytes())


def _read(file: Path, flags: int) -> np.ndarray:
    content = np.fromfile(file, np.uint8)
    image = cv2.imdecode(content, flags) if len(content) else None
    if image is None:
        raise CaptureFailed(file, "is not an image that can be read; remove it, or take the frames again")
    return image

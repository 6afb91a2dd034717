"""Masks of images: pixels where the mask is black don't count, neither in the loss nor in evaluations.

This is the convention of nerfstudio's `mask_path` and of COLMAP's masks. Transparent pixels of a mask are black. JPEG
has noise around edges, so that values below the half are black there. In instant-ngp's `dynamic_mask_NAME.png` beside
an image, all but black pixels don't count.
"""

from pathlib import Path

import numpy as np

from msdgs_train.datasets.common.images import ImageSize, read_pixels, read_size
from msdgs_train.datasets.common.paths import find_file, posix
from msdgs_train.datasets.common.readers import DatasetInvalid

DYNAMIC = "dynamic_mask_"
JPEG = (".jpg", ".jpeg")
WHITE = 255


def checked_mask(mask: Path, image: ImageSize, image_path: Path) -> Path:
    """Return the path of a mask. Raises `DatasetInvalid` if its size isn't that of the image."""
    size = read_size(mask)
    if size != image:
        raise DatasetInvalid(mask, "mask", f"is {size}, but the image {image_path} is {image}: both must be the same")
    return mask


def find_mask(folder: Path, image_name: str) -> Path | None:
    """Find the mask of an image in a folder of masks: `a.jpg.png` as COLMAP names it, `a.jpg` or `a.png`."""
    if not folder.is_dir():
        return None
    name = posix(image_name)
    candidates = (f"{name}.png", str(name), str(name.with_suffix(".png")))
    return next((found for each in candidates if (found := find_file(folder, each))), None)


def dynamic_mask(image_path: Path) -> Path | None:
    """Find instant-ngp's mask of an image."""
    path = image_path.with_name(f"{DYNAMIC}{image_path.stem}.png")
    return path if path.is_file() else None


def read_mask(path: Path) -> np.ndarray:
    """Read [H, W] bool, true where pixels count. Raises `DatasetInvalid`."""
    pixels = read_pixels(path, "uint16")
    darkest = (1 << 15) if path.suffix.lower() in JPEG else 1
    color_channels = pixels.shape[2] - (pixels.shape[2] in (2, 4))
    counts = np.any(pixels[..., :color_channels] >= darkest, axis=2)
    if color_channels < pixels.shape[2]:
        counts &= pixels[..., -1] > 0
    return ~counts if path.name.startswith(DYNAMIC) else counts


def as_rgba(mask: np.ndarray) -> np.ndarray:
    """An opaque image, `WHITE` where the mask is true, so that masks are resampled by the same code as images."""
    rgba = np.full((*mask.shape, 4), WHITE, np.uint8)
    rgba[~mask, :3] = 0
    return rgba

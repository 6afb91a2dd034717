"""Conversion from the colors of ICC profiles to sRGB."""

import io
from collections.abc import Callable
from functools import cache

import numpy as np

LEVELS = 9
"""Of each channel, in which a profile is compared with sRGB."""

Convert = Callable[[np.ndarray], np.ndarray]


@cache
def to_srgb(profile: bytes) -> Convert | None:
    """How uint8 RGB [H, W, 3] of an ICC profile, such as Display P3, becomes sRGB.

    None if it already is sRGB, within a level, or if it can't be used: no profile, or one of gray or CMYK.
    """
    from PIL import Image, ImageCms

    try:
        source, target = ImageCms.ImageCmsProfile(io.BytesIO(profile)), ImageCms.createProfile("sRGB")
        transform = ImageCms.buildTransform(source, target, "RGB", "RGB")
    except (OSError, ImageCms.PyCMSError):
        return None

    def convert(pixels: np.ndarray) -> np.ndarray:
        image = Image.fromarray(np.ascontiguousarray(pixels))
        ImageCms.applyTransform(image, transform, inPlace=True)
        return np.array(image)

    levels = np.linspace(0, 255, LEVELS).astype(np.uint8)
    some = np.stack(np.meshgrid(levels, levels, levels), axis=-1).reshape(1, -1, 3)
    differences = convert(some).astype(int) - some
    return convert if abs(differences).max() > 1 else None

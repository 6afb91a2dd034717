"""The file formats of an image and the channels that it can hold: one row each."""

from dataclasses import dataclass
from typing import Literal, get_args

ImageFormat = Literal["png", "jpeg", "webp", "exr", "npy"]
Channel = Literal["rgb", "alpha", "depth", "motion", "gaussians"]

CHANNELS: tuple[Channel, ...] = get_args(Channel)


@dataclass(frozen=True)
class FormatTraits:
    """What a format can hold and how it is announced."""

    media_type: str
    extension: str
    plugin: str | None  # OpenImageIO's name for the writer; None: written by NumPy
    holds_alpha: bool
    holds_grey: bool  # an image of one channel
    takes_quality: bool  # lossy, with a quality from 1 to 100
    holds_float: bool  # any channels as numbers; others hold one image, of color or of one channel
    max_side: int  # pixels


FORMATS: dict[ImageFormat, FormatTraits] = {
    "png": FormatTraits("image/png", ".png", "png", True, True, False, False, 16384),
    "jpeg": FormatTraits("image/jpeg", ".jpg", "jpeg", False, True, True, False, 16384),
    "webp": FormatTraits("image/webp", ".webp", "webp", True, False, True, False, 16383),
    "exr": FormatTraits("image/x-exr", ".exr", "openexr", True, True, False, True, 16384),
    "npy": FormatTraits("application/x-npy", ".npy", None, True, True, False, True, 16384),
}
assert set(FORMATS) == set(get_args(ImageFormat))

DEFAULT_QUALITY = 90


def default_channels(image_format: ImageFormat) -> tuple[Channel, ...]:
    """What a file holds where nothing is said: color, alpha and depth as numbers, or an image."""
    return ("rgb", "alpha", "depth") if FORMATS[image_format].holds_float else ("rgb",)

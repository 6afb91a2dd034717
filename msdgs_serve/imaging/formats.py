"""The table of image file formats and their capabilities."""

from dataclasses import dataclass
from typing import Literal, get_args

ImageFormat = Literal["png", "jpeg", "webp", "exr", "npy"]
Channel = Literal["rgb", "alpha", "depth", "motion", "gaussians"]

CHANNELS: tuple[Channel, ...] = get_args(Channel)


@dataclass(frozen=True)
class FormatTraits:
    """The capabilities and media type of a format."""

    media_type: str
    extension: str
    plugin: str | None  # OpenImageIO's name for the writer; None: written by NumPy
    holds_alpha: bool
    holds_gray: bool  # images of one channel
    takes_quality: bool  # lossy, with a quality from 1 to 100
    holds_float: bool  # any channels as numbers; others hold color or a single channel
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
    """Return the default channels: color, alpha and depth for formats of numbers, else color."""
    return ("rgb", "alpha", "depth") if FORMATS[image_format].holds_float else ("rgb",)

"""The file formats of an image: one row each."""

from dataclasses import dataclass
from typing import Literal, get_args

ImageFormat = Literal["png", "jpeg", "webp", "exr"]


@dataclass(frozen=True)
class FormatTraits:
    """What a format can hold and how it is announced."""

    media_type: str
    extension: str
    plugin: str  # OpenImageIO's name for the writer
    holds_alpha: bool
    takes_quality: bool  # lossy, with a quality from 1 to 100
    max_side: int  # pixels


FORMATS: dict[ImageFormat, FormatTraits] = {
    "png": FormatTraits("image/png", ".png", "png", True, False, 16384),
    "jpeg": FormatTraits("image/jpeg", ".jpg", "jpeg", False, True, 16384),
    "webp": FormatTraits("image/webp", ".webp", "webp", True, True, 16383),
    "exr": FormatTraits("image/x-exr", ".exr", "openexr", True, False, 16384),
}
assert set(FORMATS) == set(get_args(ImageFormat))

DEFAULT_QUALITY = 90

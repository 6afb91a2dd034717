"""What a render is as an image, and its encoders. No HTTP here."""

from msdgs_serve.imaging.encode import EncodingFailed, encode
from msdgs_serve.imaging.formats import CHANNELS, FORMATS, Channel, ImageFormat
from msdgs_serve.imaging.image import Image, average, linear_to_srgb, srgb_to_linear
from msdgs_serve.imaging.images import DepthRange

__all__ = [
    "CHANNELS",
    "FORMATS",
    "Channel",
    "DepthRange",
    "EncodingFailed",
    "Image",
    "ImageFormat",
    "average",
    "encode",
    "linear_to_srgb",
    "srgb_to_linear",
]

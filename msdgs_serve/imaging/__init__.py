"""Rendered images and their encoders. Independent of HTTP."""

from msdgs_serve.imaging.display import DepthRange
from msdgs_serve.imaging.encode import EncodingFailed, encode
from msdgs_serve.imaging.formats import CHANNELS, FORMATS, Channel, ImageFormat
from msdgs_serve.imaging.image import Image, average, linear_to_srgb, srgb_to_linear

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

"""What a render is as a picture, and its encoders. No HTTP here."""

from msdgs_serve.imaging.encode import EncodingFailed, encode
from msdgs_serve.imaging.formats import FORMATS, ImageFormat
from msdgs_serve.imaging.image import Image, srgb_to_linear

__all__ = ["FORMATS", "EncodingFailed", "Image", "ImageFormat", "encode", "srgb_to_linear"]

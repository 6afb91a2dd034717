"""Image → bytes of a file, through OpenImageIO. Equal images give equal bytes."""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from typing import BinaryIO

import numpy as np
import OpenImageIO as oiio

from msdgs_serve.imaging.formats import DEFAULT_QUALITY, FORMATS, ImageFormat
from msdgs_serve.imaging.image import Image
from msdgs_serve.scene import InvalidInput, MsdgsError

Attributes = dict[str, int | float | str]

DISPLAY_ATTRIBUTES: Attributes = {
    "oiio:ColorSpace": "srgb_rec709_scene",
    "oiio:UnassociatedAlpha": 1,  # the pixels are straight: without it the writer divides by alpha once more
}
PNG_ATTRIBUTES: Attributes = {
    "png:compressionLevel": 1,
    "png:filter": 64,  # Paeth for every row; at level 1: 2 times faster than trying all filters, same size
}
WEBP_ATTRIBUTES: Attributes = {"webp:method": 0}  # 4 times faster than the default with soft alpha, 10-30 % larger
EXR_ATTRIBUTES: Attributes = {
    "compression": "zips",  # 4 times faster than "zip" while other threads compute, files 4 % larger
    "oiio:ColorSpace": "lin_rec709_scene",
    "DateTime": "1970:01:01 00:00:00",  # otherwise the writer puts in the time of writing
}
# CIE xy of red, green, blue and white
REC709_CHROMATICITIES = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)


class EncodingFailed(MsdgsError):
    """The image library refused to write an image."""


def encode(image: Image, image_format: ImageFormat, quality: int | None = None) -> bytes:
    """The image as a file of `image_format`.

    PNG, JPEG and WebP hold 8-bit sRGB, with straight alpha where the image is transparent (JPEG can't be). EXR holds
    32-bit float scene-linear Rec.709 premultiplied R, G, B, A and depth Z. `quality` in [1, 100] is for JPEG and WebP.
    Raises `InvalidInput` naming `format`, `quality`, `width` or `height`.
    """
    check_encodable(image.width, image.height, image.transparent, image_format, quality)
    if image_format == "exr":
        return _write(image.linear_pixels(), _exr_spec(image), image_format)
    pixels = image.display_pixels()
    spec = oiio.ImageSpec(image.width, image.height, pixels.shape[2], oiio.UINT8)
    _set(spec, DISPLAY_ATTRIBUTES)
    if image_format == "png":
        _set(spec, PNG_ATTRIBUTES)
    if image_format == "webp":
        _set(spec, WEBP_ATTRIBUTES)
    if FORMATS[image_format].takes_quality:
        spec.attribute("Compression", f"{image_format}:{quality or DEFAULT_QUALITY}")
    return _write(pixels, spec, image_format)


def check_encodable(width: int, height: int, transparent: bool, image_format: ImageFormat, quality: int | None) -> None:
    """Raise `InvalidInput` for what `encode` would refuse, so that nothing is rendered in vain."""
    if image_format not in FORMATS:
        raise InvalidInput("format", f"one of {', '.join(FORMATS)}", image_format)
    traits = FORMATS[image_format]
    if transparent and not traits.holds_alpha:
        raise InvalidInput("background", f"opaque for {image_format}", "transparent")
    if quality is not None and not traits.takes_quality:
        raise InvalidInput("quality", f"left out for {image_format}", quality)
    if quality is not None and not 1 <= quality <= 100:
        raise InvalidInput("quality", "in [1, 100]", quality)
    for name, side in (("width", width), ("height", height)):
        if side > traits.max_side:
            raise InvalidInput(name, f"at most {traits.max_side} for {image_format}", side)


def _exr_spec(image: Image) -> oiio.ImageSpec:
    spec = oiio.ImageSpec(image.width, image.height, 5, oiio.FLOAT)
    spec.channelnames = ("R", "G", "B", "A", "Z")
    spec.alpha_channel = 3
    spec.z_channel = 4
    _set(spec, EXR_ATTRIBUTES)
    spec.attribute("chromaticities", "float[8]", REC709_CHROMATICITIES)
    return spec


def _set(spec: oiio.ImageSpec, attributes: Attributes) -> None:
    for name, value in attributes.items():
        spec.attribute(name, value)


def _write(pixels: np.ndarray, spec: oiio.ImageSpec, image_format: ImageFormat) -> bytes:
    output = oiio.ImageOutput.create(FORMATS[image_format].plugin)
    if output is None:
        raise EncodingFailed(f"no writer for {image_format}: {oiio.geterror()}")
    with _scratch_file() as (path, file):
        if not (output.open(path, spec) and output.write_image(np.ascontiguousarray(pixels)) and output.close()):
            raise EncodingFailed(f"cannot write {image_format}: {output.geterror()}")
        return file.read()


@contextmanager
def _scratch_file() -> Iterator[tuple[str, BinaryIO]]:
    """A path to write to and the file to read it back from; in memory where the system can (Linux)."""
    if hasattr(os, "memfd_create"):
        with open(os.memfd_create("image"), "rb") as file:
            yield f"/proc/self/fd/{file.fileno()}", file
    else:
        with tempfile.TemporaryDirectory() as folder:
            path = os.path.join(folder, "image")
            with open(path, "w+b") as file:
                yield path, file

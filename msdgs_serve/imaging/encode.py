"""Encode images as files with OpenImageIO and NumPy. Equal images give equal bytes."""

import io
from collections.abc import Sequence

import numpy as np
import OpenImageIO as oiio

from msdgs_serve.files import scratch_file
from msdgs_serve.imaging.display import DepthRange, channel_of, display_image
from msdgs_serve.imaging.exr_header import camera_attributes
from msdgs_serve.imaging.formats import CHANNELS, DEFAULT_QUALITY, FORMATS, Channel, ImageFormat, default_channels
from msdgs_serve.imaging.image import Image
from msdgs_serve.scene import InvalidInput, MsdgsError

Attributes = dict[str, int | float | str]

DISPLAY_ATTRIBUTES: Attributes = {
    "oiio:ColorSpace": "srgb_rec709_scene",
    "oiio:UnassociatedAlpha": 1,  # straight alpha: otherwise the writer divides by alpha
}
PNG_ATTRIBUTES: Attributes = {
    "png:compressionLevel": 1,
    "png:filter": 64,  # Paeth for every row: at level 1 twice as fast as trying all filters, same size
}
WEBP_ATTRIBUTES: Attributes = {"webp:method": 0}  # 4 times faster than the default with soft alpha, 10-30 % larger
EXR_ATTRIBUTES: Attributes = {
    "compression": "zips",  # 4 times faster than "zip" while other threads compute, files 4 % larger
    "oiio:ColorSpace": "lin_rec709_scene",
    "DateTime": "1970:01:01 00:00:00",  # otherwise the writer stores the current time
}
# CIE xy of red, green, blue and white
REC709_CHROMATICITIES = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
EXR_NAMES: dict[Channel, tuple[str, ...]] = {
    "rgb": ("R", "G", "B"),
    "alpha": ("A",),
    "depth": ("Z",),
    "motion": ("forward.u", "forward.v"),  # backward if it points to an earlier time
    "gaussians": ("gaussians",),
}

oiio.attribute("threads", 1)  # 3 times as fast for a 400 × 400 JPEG as with its own threads, which busy-wait


class EncodingFailed(MsdgsError):
    """The image library failed to write an image."""


def encode(
    image: Image,
    image_format: ImageFormat,
    quality: int | None = None,
    channels: Sequence[Channel] | None = None,
    depth_range: DepthRange | None = None,
) -> bytes:
    """Return the image as a file of `image_format`.

    PNG, JPEG and WebP hold an 8-bit image: sRGB with straight alpha if the image is transparent (not in JPEG),
    or a single channel. EXR holds any channels as 32-bit floats: scene-linear Rec.709 premultiplied R, G, B, A and
    depth Z, motion as forward.u and forward.v (backward to an earlier time), gaussians, with the camera and the time in
    its header. NPY holds float32 [H, W, C] as rendered: sRGB-encoded color.
    `quality` in [1, 100] is for JPEG and WebP. Raises `InvalidInput` naming the parameter.
    """
    check_encodable(image.width, image.height, image.transparent, image_format, quality, channels)
    channels, traits = channels or default_channels(image_format), FORMATS[image_format]
    if image_format == "npy":
        return npy(numbers(image, channels))
    if image_format == "exr":
        return _write(_exr_pixels(image, channels), _exr_spec(image, channels), image_format)
    pixels = display_image(image, channels[0], depth_range)
    if pixels.shape[2] == 1 and not traits.holds_gray:
        pixels = np.repeat(pixels, 3, axis=2)
    spec = oiio.ImageSpec(image.width, image.height, pixels.shape[2], oiio.UINT8)
    _set(spec, DISPLAY_ATTRIBUTES)
    if image_format == "png":
        _set(spec, PNG_ATTRIBUTES)
    if image_format == "webp":
        _set(spec, WEBP_ATTRIBUTES)
    if traits.takes_quality:
        spec.attribute("Compression", f"{image_format}:{quality or DEFAULT_QUALITY}")
    return _write(pixels, spec, image_format)


def check_encodable(
    width: int,
    height: int,
    transparent: bool,
    image_format: ImageFormat,
    quality: int | None,
    channels: Sequence[Channel] | None = None,
) -> None:
    """Raise `InvalidInput` for arguments that `encode` would reject, before anything is rendered."""
    if image_format not in FORMATS:
        raise InvalidInput("format", f"one of {', '.join(FORMATS)}", image_format)
    traits = FORMATS[image_format]
    if transparent and not traits.holds_alpha and "rgb" in (channels or ("rgb",)):
        raise InvalidInput("background", f"opaque for {image_format}", "transparent")
    if quality is not None and not traits.takes_quality:
        raise InvalidInput("quality", f"left out for {image_format}", quality)
    if quality is not None and not 1 <= quality <= 100:
        raise InvalidInput("quality", "in [1, 100]", quality)
    if channels is not None:
        _check_channels(channels, image_format)
    for name, side in (("width", width), ("height", height)):
        if side > traits.max_side:
            raise InvalidInput(name, f"at most {traits.max_side} for {image_format}", side)


def numbers(image: Image, channels: Sequence[Channel]) -> np.ndarray:
    """Return the channels as rendered, [H, W, C] float32, in the given order; color is sRGB-encoded."""
    parts = [channel_of(image, channel) for channel in channels]
    return np.dstack(parts).astype(np.float32, copy=False)


def npy(array: np.ndarray) -> bytes:
    """Return the array as a .npy file."""
    file = io.BytesIO()
    np.lib.format.write_array(file, np.ascontiguousarray(array), allow_pickle=False)
    return file.getvalue()


def _check_channels(channels: Sequence[Channel], image_format: ImageFormat) -> None:
    for channel in channels:
        if channel not in CHANNELS:
            raise InvalidInput("channels", f"a list of {', '.join(CHANNELS)}", channel)
    if not channels or len(set(channels)) < len(channels):
        raise InvalidInput("channels", "a list of different channels", list(channels))
    if len(channels) > 1 and not FORMATS[image_format].holds_float:
        raise InvalidInput("channels", f"a single channel for {image_format}", list(channels))


def _exr_pixels(image: Image, channels: Sequence[Channel]) -> np.ndarray:
    """Return channels in linear light, [H, W, C] float32. Alpha is 1 unless the image is transparent."""

    def part(channel: Channel) -> np.ndarray:
        if channel == "rgb":
            return image.linear_rgb()
        if channel == "alpha" and not image.transparent:
            return np.ones_like(image.alpha)
        return channel_of(image, channel)

    return np.dstack([part(channel) for channel in channels]).astype(np.float32, copy=False)


def _exr_spec(image: Image, channels: Sequence[Channel]) -> oiio.ImageSpec:
    names = [name for channel in channels for name in EXR_NAMES[channel]]
    if image.motion_dt is not None and image.motion_dt < 0:
        names = [name.replace("forward", "backward") for name in names]
    spec = oiio.ImageSpec(image.width, image.height, len(names), oiio.FLOAT)
    spec.channelnames = tuple(names)
    if image.region is not None and image.camera is not None:  # data window and display window
        spec.x, spec.y = image.region.x, image.region.y
        spec.full_width, spec.full_height = image.camera.width, image.camera.height
    spec.alpha_channel = names.index("A") if "A" in names else -1
    spec.z_channel = names.index("Z") if "Z" in names else -1
    _set(spec, EXR_ATTRIBUTES)
    spec.attribute("chromaticities", "float[8]", REC709_CHROMATICITIES)
    if image.camera is not None and image.t is not None:
        for name, (kind, value) in camera_attributes(image.camera, image.t).items():
            spec.attribute(name, kind, value)
    return spec


def _set(spec: oiio.ImageSpec, attributes: Attributes) -> None:
    for name, value in attributes.items():
        spec.attribute(name, value)


def _write(pixels: np.ndarray, spec: oiio.ImageSpec, image_format: ImageFormat) -> bytes:
    output = oiio.ImageOutput.create(FORMATS[image_format].plugin or "")
    if output is None:
        raise EncodingFailed(f"no writer for {image_format}: {oiio.geterror()}")
    with scratch_file() as (path, contents):
        if not (output.open(path, spec) and output.write_image(np.ascontiguousarray(pixels)) and output.close()):
            raise EncodingFailed(f"cannot write {image_format}: {output.geterror()}")
        return contents()

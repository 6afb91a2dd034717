"""Images as 8-bit RGBA with straight alpha: reading, downscaling and compositing."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import OpenImageIO as oiio

from msdgs_serve.files import scratch_file
from msdgs_serve.rasterizer.jit import kernel
from msdgs_serve.writing import writing
from msdgs_train.datasets.common import jpeg
from msdgs_train.datasets.common.color_profiles import to_srgb
from msdgs_train.datasets.common.readers import DatasetInvalid

EXTENSIONS = (".png", ".jpg", ".jpeg")
TURNED = range(5, 9)
"""EXIF's orientations that exchange width and height."""
COPY_AGAIN = "copy it again from where it came"
CONVERT = "convert it to PNG of 8 or 16 bits, with the colors that a screen shows"
HALF = 0.5 + 1e-9
"""Added before rounding down, so that halves go up whatever the error of the division before."""


class ImageSize(NamedTuple):
    """Width and height in pixels."""

    width: int
    height: int

    def __str__(self) -> str:
        return f"{self.width}×{self.height}"

    def has_shape_of(self, copy: "ImageSize") -> bool:
        """Whether a copy of an image of this size may have the other size, one side of which is rounded to pixels."""
        if min(*self, *copy) <= 0:
            return False
        if self.width == copy.width or self.height == copy.height:
            return self == copy
        difference = abs(self.width * copy.height - self.height * copy.width)
        return difference < max(self)


class ImageHeader(NamedTuple):
    """What an image says of itself."""

    size: ImageSize  # as it is stored
    orientation: int  # EXIF's number, 1 if it is shown as it is stored


def read_header(path: Path) -> ImageHeader:
    """Read an image's header. Raises `DatasetInvalid`."""
    reader = _open(path)
    spec = reader.spec()
    reader.close()
    return ImageHeader(ImageSize(spec.width, spec.height), int(spec.getattribute("Orientation") or 1))


def read_size(path: Path) -> ImageSize:
    """Read the size in an image's header. Raises `DatasetInvalid`."""
    return read_header(path).size


def other_shape(stated: ImageSize, path: Path) -> str:
    """Why the image isn't one of the stated size, nor a copy of it, and what to do; the end of a message."""
    (width, height), orientation = read_header(path)
    problem = f"but the image is {width}×{height}"
    if orientation in TURNED and stated.has_shape_of(ImageSize(height, width)):
        remedy = "store the images upright, as their poses are, without it"
        return f"{problem}, which its EXIF orientation {orientation} turns: {remedy}"
    return f"{problem}, no copy of that one: give the size that the intrinsics are for, or images that are not cut"


def read_rgba(path: Path) -> np.ndarray:
    """Read [H, W, 4] uint8 sRGB, straight alpha, opaque without alpha; gray becomes RGB. Raises `DatasetInvalid`."""
    pixels, profile = _read(path, "uint8")
    channels = pixels.shape[2]
    rgba = np.full((*pixels.shape[:2], 4), 255, np.uint8)
    rgba[..., :3] = pixels[..., :3] if channels >= 3 else pixels[..., :1]
    if channels in (2, 4):
        rgba[..., 3] = pixels[..., -1]
    if profile and (convert := to_srgb(profile)):
        rgba[..., :3] = convert(rgba[..., :3])
    return rgba


def read_pixels(path: Path, dtype: str) -> np.ndarray:
    """Read [H, W, channels] as "uint8" or "uint16", whose largest value is that of the file's type."""
    return _read(path, dtype)[0]


def _read(path: Path, dtype: str) -> tuple[np.ndarray, bytes]:
    """The pixels, and the ICC profile, empty if there is none."""
    reader = _open(path)
    stored = reader.spec().getattribute("ICCProfile")
    pixels = reader.read_image(dtype)
    problem, is_jpeg = reader.geterror(), reader.format_name() == "jpeg"
    reader.close()
    if pixels is None:
        raise _unreadable(path, f"{problem.splitlines()[0] if problem else 'no pixels'}: {COPY_AGAIN}")
    if is_jpeg and not jpeg.is_whole(path.read_bytes()):
        raise DatasetInvalid(path, "image", f"is cut off: {COPY_AGAIN}, or store it anew if nothing is missing")
    return pixels, b"" if stored is None else np.asarray(stored, np.uint8).tobytes()


def resize_area(rgba: np.ndarray, width: int, height: int) -> np.ndarray:
    """Downscale uint8 [H, W, 4] to [height, width, 4]: each new pixel is the mean over the area it covers.

    Colors are weighted by alpha, so that colors of transparent pixels do not bleed in; fully transparent areas become
    black. At half the size this is the exact 2×2 box filter.
    """
    if rgba.shape[:2] == (height, width):
        return rgba
    means = np.empty((height, width, 4), np.uint8)
    _area_means(np.ascontiguousarray(rgba), means)
    return means


def composite(rgba: np.ndarray, background: np.ndarray | tuple[float, float, float]) -> np.ndarray:
    """Composite uint8 [H, W, 4] with straight alpha over an RGB background in [0, 1]; returns float32 [H, W, 3]."""
    rgb = np.empty((*rgba.shape[:2], 3), np.float32)
    _composite(np.ascontiguousarray(rgba).reshape(-1, 4), np.asarray(background, np.float32), rgb.reshape(-1, 3))
    return rgb


def write_png(path: Path, pixels: np.ndarray) -> None:
    """Write uint8 [H, W, 3 or 4], sRGB, straight alpha. Equal pixels give equal files. Raises `WriteFailed`."""
    height, width, channels = pixels.shape
    spec = oiio.ImageSpec(width, height, channels, "uint8")
    spec.attribute("oiio:ColorSpace", "srgb_rec709_scene")
    spec.attribute("oiio:UnassociatedAlpha", 1)
    writer = oiio.ImageOutput.create("png")
    assert writer is not None
    with writing(path), scratch_file() as (scratch, contents):  # the library doesn't notice a full disk
        if not (writer.open(scratch, spec) and writer.write_image(pixels) and writer.close()):
            raise ValueError(f"no PNG of {width} × {height} pixels: {writer.geterror()}")
        path.write_bytes(contents())


@kernel
def _composite(rgba: np.ndarray, background: np.ndarray, rgb: np.ndarray) -> None:
    """Write [P, 3]; with NumPy's operations a training step at 400 × 400 takes 1.05 times as long."""
    unit = np.float32(1 / 255)
    for pixel in range(np.uint64(len(rgba))):
        alpha = unit * np.float32(rgba[pixel, 3])
        for channel in range(3):
            behind = background[channel]
            rgb[pixel, channel] = behind + alpha * (unit * np.float32(rgba[pixel, channel]) - behind)


@kernel
def _area_means(rgba: np.ndarray, means: np.ndarray) -> None:
    """Write [height, width, 4]; NumPy's cumulative sums take 20 to 60 times as long and 20 times the memory."""
    (old_height, old_width, _), (height, width, _) = rgba.shape, means.shape
    columns = np.empty((old_width, 4))  # colors times alpha, and alpha, over the rows of a new pixel
    for row in range(height):
        top, bottom = row * old_height / height, (row + 1) * old_height / height
        columns[:] = 0
        for y in range(row * old_height // height, -(-(row + 1) * old_height // height)):
            part = min(bottom, y + 1.0) - max(top, float(y))
            for x in range(np.uint64(old_width)):
                alpha = part * rgba[y, x, 3]
                for channel in range(3):
                    columns[x, channel] += alpha * rgba[y, x, channel]
                columns[x, 3] += alpha
        for column in range(width):
            left, right = column * old_width / width, (column + 1) * old_width / width
            red = green = blue = alpha = 0.0
            for x in range(column * old_width // width, -(-(column + 1) * old_width // width)):
                part = min(right, x + 1.0) - max(left, float(x))
                red, green = red + part * columns[x, 0], green + part * columns[x, 1]
                blue, alpha = blue + part * columns[x, 2], alpha + part * columns[x, 3]
            of_colors = 1 / alpha if alpha > 0 else 0.0
            area = (bottom - top) * (right - left)
            means[row, column, 0] = int(red * of_colors + HALF)
            means[row, column, 1] = int(green * of_colors + HALF)
            means[row, column, 2] = int(blue * of_colors + HALF)
            means[row, column, 3] = int(alpha / area + HALF)


def _open(path: Path) -> "oiio.ImageInput":  # quoted, or OpenImageIO's bindings report leaks after `--help`
    reader = _opened(path)
    spec = reader.spec()
    if spec.format.basetype not in (oiio.UINT8, oiio.UINT16) or spec.nchannels > 4:
        reader.close()
        raise _unreadable(
            path, f"{spec.nchannels} channels of {spec.format}; 1 to 4 of 8 or 16 bits are supported: {CONVERT}"
        )
    return reader


def _opened(path: Path) -> "oiio.ImageInput":
    """A reader of the file, of Ultra HDR that of its image for usual screens."""
    try:
        with path.open("rb") as file:
            has_gain_map = jpeg.has_gain_map(file)
    except OSError as error:
        raise _unreadable(path, str(error.strerror)) from None
    straight = oiio.ImageSpec()
    straight.attribute("oiio:UnassociatedAlpha", 1)
    if has_gain_map:
        with scratch_file() as (scratch, _):
            Path(scratch).write_bytes(jpeg.without_gain_map(path.read_bytes()))
            reader = oiio.ImageInput.open(scratch, straight)
    else:
        reader = oiio.ImageInput.open(str(path), straight)
    if reader is None:
        raise _unreadable(path, f"{oiio.geterror().splitlines()[0]}: {COPY_AGAIN}, or convert it to JPEG or PNG")
    return reader


def _unreadable(path: Path, problem: str) -> DatasetInvalid:
    return DatasetInvalid(path, "image", f"can't be read: {problem}")

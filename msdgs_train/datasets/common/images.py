"""Images as 8-bit RGBA with straight alpha: reading, downscaling and compositing."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import OpenImageIO as oiio

from msdgs_serve.files import scratch_file
from msdgs_serve.rasterizer.jit import kernel
from msdgs_serve.writing import writing
from msdgs_train.datasets.common.readers import DatasetInvalid

EXTENSIONS = (".png", ".jpg", ".jpeg")


class ImageSize(NamedTuple):
    """Width and height in pixels."""

    width: int
    height: int

    def __str__(self) -> str:
        return f"{self.width}×{self.height}"

    def has_shape_of(self, other: "ImageSize") -> bool:
        """Whether the aspect ratios agree within 1 %, since sizes of copies are rounded to whole pixels."""
        across, down = self.width * other.height, self.height * other.width
        return min(*self, *other) > 0 and 100 * abs(across - down) <= down


def read_size(path: Path) -> ImageSize:
    """Read the size in an image's header. Raises `DatasetInvalid`."""
    reader = _open(path)
    spec = reader.spec()
    reader.close()
    return ImageSize(spec.width, spec.height)


def read_rgba(path: Path) -> np.ndarray:
    """Read [H, W, 4] uint8, straight alpha; gray becomes RGB, without alpha it is opaque. Raises `DatasetInvalid`."""
    pixels = read_pixels(path, "uint8")
    channels = pixels.shape[2]
    rgba = np.full((*pixels.shape[:2], 4), 255, np.uint8)
    rgba[..., :3] = pixels[..., :3] if channels >= 3 else pixels[..., :1]
    if channels in (2, 4):
        rgba[..., 3] = pixels[..., -1]
    return rgba


def read_pixels(path: Path, dtype: str) -> np.ndarray:
    """Read [H, W, channels] as "uint8" or "uint16", whose largest value is that of the file's type."""
    reader = _open(path)
    pixels = reader.read_image(dtype)
    problem = reader.geterror()
    reader.close()
    if pixels is None:
        raise _unreadable(path, problem.splitlines()[0] if problem else "no pixels")
    return pixels


def resize_area(rgba: np.ndarray, width: int, height: int) -> np.ndarray:
    """Downscale uint8 [H, W, 4] to [height, width, 4]: each new pixel is the mean over the area it covers.

    Colors are weighted by alpha, so that colors of transparent pixels do not bleed in; fully transparent areas become
    black. At half the size this is the exact 2×2 box filter.
    """
    if rgba.shape[:2] == (height, width):
        return rgba
    means = rgba.astype(np.float64)
    means[..., :3] *= means[..., 3:]
    means = _cell_means(_cell_means(means, height).swapaxes(0, 1), width).swapaxes(0, 1)
    alpha = means[..., 3:]
    means[..., :3] /= np.where(alpha > 0, alpha, 1)
    return np.floor(means + 0.5).astype(np.uint8)


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


def _cell_means(rows: np.ndarray, count: int) -> np.ndarray:
    """Average float64 [length, …] over `count` equal cells, [count, …]; cell borders may split rows.

    Computed as differences of cumulative sums, at a cost that doesn't depend on the cell size.
    """
    length = len(rows)
    sums = np.zeros((length + 1, *rows.shape[1:]))
    np.cumsum(rows, axis=0, out=sums[1:])
    edges = np.arange(count + 1) * (length / count)
    below = np.minimum(edges.astype(np.int64), length - 1)
    cut = (edges - below).reshape(-1, *[1] * (rows.ndim - 1)) * rows[below]
    return np.diff(sums[below] + cut, axis=0) * (count / length)


def _open(path: Path) -> "oiio.ImageInput":  # quoted, or OpenImageIO's bindings report leaks after `--help`
    straight = oiio.ImageSpec()
    straight.attribute("oiio:UnassociatedAlpha", 1)
    reader = oiio.ImageInput.open(str(path), straight)
    if reader is None:
        raise _unreadable(path, oiio.geterror().splitlines()[0])
    spec = reader.spec()
    if spec.format.basetype not in (oiio.UINT8, oiio.UINT16) or spec.nchannels > 4:
        reader.close()
        raise _unreadable(path, f"{spec.nchannels} channels of {spec.format}; 1 to 4 of 8 or 16 bits are supported")
    return reader


def _unreadable(path: Path, problem: str) -> DatasetInvalid:
    return DatasetInvalid(path, "image", f"can't be read: {problem}")

"""Decoding of encoded images, and metrics to compare them."""

import io
import tempfile

import numpy as np
import OpenImageIO as oiio

from msdgs_serve.imaging import FORMATS
from msdgs_serve.imaging.formats import ImageFormat


def decode(body: bytes, image_format: ImageFormat) -> tuple[np.ndarray, oiio.ImageSpec]:
    """Pixels as stored (straight alpha stays straight) and the header, empty for `npy`."""
    if image_format == "npy":
        return np.load(io.BytesIO(body), allow_pickle=False), oiio.ImageSpec()
    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)
    with tempfile.NamedTemporaryFile(suffix=FORMATS[image_format].extension) as file:
        file.write(body)
        file.flush()
        reader = oiio.ImageInput.open(file.name, config)
        assert reader, oiio.geterror()
        pixels = reader.read_image(reader.spec().format)
        assert pixels is not None, reader.geterror()
        return pixels, reader.spec()


def linear_to_srgb(linear: np.ndarray) -> np.ndarray:
    """The sRGB transfer function (IEC 61966-2-1); values above 1 follow the same power."""
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055)


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    """Decibels, for values in [0, 1]."""
    return float(10 * np.log10(1 / np.mean((a - b) ** 2)))

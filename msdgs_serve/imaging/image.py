"""An image of named float channels, and the colour arithmetic its encoders need."""

from dataclasses import dataclass

import numpy as np

from msdgs_serve.scene import InvalidInput
from msdgs_serve.scene.gaussians import FloatArray


@dataclass(frozen=True)
class Image:
    """One rendered frame, rows from the top.

    `rgb` is display-referred (sRGB-encoded) and already blended with the background; where `transparent`, there is no
    background and `rgb` is premultiplied by `alpha`. Values above 1 are possible.
    """

    rgb: FloatArray  # [H, W, 3] sRGB-encoded, >= 0
    alpha: FloatArray  # [H, W] coverage by Gaussians in [0, 1], whatever the background
    depth: FloatArray  # [H, W] along the camera axis, scene units; infinite where alpha is 0
    transparent: bool = False

    def __post_init__(self) -> None:
        if self.rgb.ndim != 3 or self.rgb.shape[2] != 3:
            raise InvalidInput("image.rgb", "of shape (height, width, 3)", self.rgb.shape)
        for name in ("alpha", "depth"):
            if getattr(self, name).shape != self.rgb.shape[:2]:
                raise InvalidInput(f"image.{name}", f"of shape {self.rgb.shape[:2]}", getattr(self, name).shape)

    @property
    def width(self) -> int:
        return self.rgb.shape[1]

    @property
    def height(self) -> int:
        return self.rgb.shape[0]

    def display_pixels(self) -> np.ndarray:
        """8-bit sRGB, rounded to nearest: [H, W, 3], or [H, W, 4] with straight alpha where `transparent`."""
        if not self.transparent:
            return _to_8_bits(self.rgb)
        pixels = np.empty((self.height, self.width, 4), np.uint8)
        pixels[..., :3] = _to_8_bits(_straight(self.rgb, self.alpha))
        pixels[..., 3] = _to_8_bits(self.alpha)
        return pixels

    def linear_pixels(self) -> FloatArray:
        """[H, W, 5] float32: scene-linear Rec.709 R, G, B premultiplied by A, and the depth Z.

        A is 1 everywhere unless `transparent`. The transfer function is not linear, so that it is undone on straight
        colour, between taking alpha out and putting it back.
        """
        pixels = np.empty((self.height, self.width, 5), np.float32)
        if self.transparent:
            np.multiply(srgb_to_linear(_straight(self.rgb, self.alpha)), self.alpha[..., None], out=pixels[..., :3])
            pixels[..., 3] = self.alpha
        else:
            pixels[..., :3] = srgb_to_linear(self.rgb)
            pixels[..., 3] = 1
        pixels[..., 4] = self.depth
        return pixels


def srgb_to_linear(encoded: FloatArray) -> FloatArray:
    """Undo the sRGB transfer function (IEC 61966-2-1); values above 1 follow the same power."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((np.maximum(encoded, 0.04045) + 0.055) / 1.055) ** 2.4)


def _straight(premultiplied: FloatArray, alpha: FloatArray) -> FloatArray:
    """[H, W, 3] colour with alpha taken out; where alpha is 0, premultiplied colour is 0 and stays so."""
    return premultiplied / np.where(alpha > 0, alpha, 1)[..., None]


def _to_8_bits(values: FloatArray) -> np.ndarray:
    return (np.clip(values, 0, 1) * 255 + 0.5).astype(np.uint8)

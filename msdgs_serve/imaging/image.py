"""An image of named float channels, and its color conversions."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from msdgs_serve.scene import Camera, InvalidInput, Region
from msdgs_serve.scene.gaussians import FloatArray


@dataclass(frozen=True)
class Image:
    """One rendered frame, rows from the top.

    `rgb` is display-referred (sRGB-encoded) and blended with the background; if `transparent`, there is no background
    and `rgb` is premultiplied by `alpha`. Values above 1 are possible.
    """

    rgb: FloatArray  # [H, W, 3] sRGB-encoded, >= 0
    alpha: FloatArray  # [H, W] coverage by Gaussians in [0, 1]
    depth: FloatArray | None = None  # [H, W] along the camera axis, world units; infinite if alpha is 0
    transparent: bool = False
    camera: Camera | None = None  # for formats that store it
    t: float | None = None  # scene time
    motion: FloatArray | None = None  # [H, W, 2] displacement, pixels to the right and down; 0 if alpha is 0
    motion_dt: float | None = None  # scene time from `t` to where motion points; before `t` if below 0
    gaussians: FloatArray | None = None  # [H, W] number that contribute to each pixel
    region: Region | None = None  # of the camera's image; None: all of it

    def __post_init__(self) -> None:
        if self.rgb.ndim != 3 or self.rgb.shape[2] != 3:
            raise InvalidInput("image.rgb", "of shape (height, width, 3)", self.rgb.shape)
        for name in ("alpha", "depth"):
            values = getattr(self, name)
            if values is not None and values.shape != self.rgb.shape[:2]:
                raise InvalidInput(f"image.{name}", f"of shape {self.rgb.shape[:2]}", values.shape)

    @property
    def width(self) -> int:
        return self.rgb.shape[1]

    @property
    def height(self) -> int:
        return self.rgb.shape[0]

    def as_shown(self) -> FloatArray:
        """Return sRGB-encoded color, [H, W, 3], or [H, W, 4] with straight alpha if `transparent`."""
        if not self.transparent:
            return self.rgb
        return np.concatenate([_straight(self.rgb, self.alpha), self.alpha[..., None]], axis=2)

    def display_pixels(self) -> np.ndarray:
        """Return `as_shown` in 8 bits, rounded to nearest and clipped."""
        scaled = self.as_shown() * 255
        scaled += 0.5  # in place: 4 times faster than one expression
        return np.clip(scaled, 0, 255, out=scaled).astype(np.uint8)

    def linear_rgb(self) -> FloatArray:
        """Return scene-linear Rec.709 color, [H, W, 3], premultiplied by alpha if `transparent`.

        The transfer function is not linear and is inverted on straight color.
        """
        if not self.transparent:
            return srgb_to_linear(self.rgb)
        return srgb_to_linear(_straight(self.rgb, self.alpha)) * self.alpha[..., None]


def average(images: Iterable[Image]) -> Image:
    """Return the mean of frames of one camera: color in linear light, depth weighted by alpha, numbers of Gaussians.
    Keeps one frame in memory at a time."""
    count, first = 0, None
    light = coverage = depth = gaussians = np.zeros(())
    for image in images:
        first = first or image
        count += 1
        light = light + image.linear_rgb().astype(np.float64)
        coverage = coverage + image.alpha.astype(np.float64)
        if image.gaussians is not None:
            gaussians = gaussians + image.gaussians
        if image.depth is not None:
            depth = depth + np.where(image.alpha > 0, image.depth, 0).astype(np.float64) * image.alpha
    if first is None:
        raise InvalidInput("images", "at least one", 0)
    alpha = coverage / count
    linear = light / count
    rgb = linear_to_srgb(_straight(linear, alpha)) * alpha[..., None] if first.transparent else linear_to_srgb(linear)
    mean_depth, dtype = None, first.rgb.dtype
    if first.depth is not None:
        mean_depth = np.divide(depth, coverage, out=np.full(alpha.shape, np.inf), where=coverage > 0).astype(dtype)
    return replace(
        first,
        motion=None,
        rgb=rgb.astype(dtype),
        alpha=alpha.astype(dtype),
        depth=mean_depth,
        gaussians=None if first.gaussians is None else (gaussians / count).astype(dtype),
    )


def srgb_to_linear(encoded: FloatArray) -> FloatArray:
    """Invert the sRGB transfer function (IEC 61966-2-1), extended to values above 1."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((np.maximum(encoded, 0.04045) + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(linear: FloatArray) -> FloatArray:
    """Apply the sRGB transfer function (IEC 61966-2-1), extended to values above 1."""
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055)


def _straight(premultiplied: FloatArray, alpha: FloatArray) -> FloatArray:
    """Return straight color, [H, W, 3]; 0 if alpha is 0."""
    return premultiplied / np.where(alpha > 0, alpha, 1)[..., None]

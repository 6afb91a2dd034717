"""Display images of single channels."""

from typing import NamedTuple

import numpy as np

from msdgs_serve.imaging.formats import Channel
from msdgs_serve.imaging.image import Image
from msdgs_serve.scene import InvalidInput

FARTHEST_BRIGHTNESS = 0.15
"""Brightness of the farthest depth; empty pixels are black."""


class DepthRange(NamedTuple):
    """The depths that are drawn brightest and darkest."""

    near: float
    far: float


def display_image(image: Image, channel: Channel, depth_range: DepthRange | None = None) -> np.ndarray:
    """Return a display image of a channel: [H, W, 3], [H, W, 4] with straight alpha for transparent color, or [H, W, 1]
    for a scalar channel. Values are in [0, 1], except for colors above 1.

    The hue of motion is its direction; its brightness is relative to the fastest motion in the image. Depth is brighter
    the nearer it is, over `depth_range` or the depths of the image. Both are multiplied by alpha. Numbers of Gaussians
    are relative to the highest in the image.
    """
    if channel == "rgb":
        return image.as_shown()
    if channel == "alpha":
        return image.alpha[..., None]
    if channel == "motion":
        return _motion_colors(channel_of(image, "motion") * image.alpha[..., None])
    if channel == "gaussians":
        counts = channel_of(image, "gaussians")
        return (counts / max(float(counts.max(initial=0.0)), 1.0))[..., None]
    depth = channel_of(image, "depth")
    near, far = depth_range or depths_of(depth)
    seen = np.isfinite(depth)
    place = np.clip((np.where(seen, depth, far) - near) / max(far - near, 1e-12), 0, 1)
    return (np.where(seen, 1 - (1 - FARTHEST_BRIGHTNESS) * place, 0) * image.alpha)[..., None]


def channel_of(image: Image, channel: Channel) -> np.ndarray:
    """Return the values of a channel. Raises `InvalidInput` if it was not drawn."""
    values = getattr(image, channel)
    if values is None:
        raise InvalidInput("channels", f"without {channel}, which was not drawn", channel)
    return values


def _motion_colors(motion: np.ndarray) -> np.ndarray:
    speed = np.hypot(motion[..., 0], motion[..., 1])
    brightness = speed / max(float(speed.max(initial=0.0)), 1e-12)
    angles = np.arctan2(motion[..., 1], motion[..., 0])[..., None] + np.radians([0, 240, 120])
    return brightness[..., None] * (0.5 + 0.5 * np.cos(angles))


def depths_of(depth: np.ndarray) -> DepthRange:
    """Return the nearest and farthest depth of an image; 0 and 1 if it is empty."""
    seen = depth[np.isfinite(depth)]
    return DepthRange(float(seen.min()), float(seen.max())) if seen.size else DepthRange(0.0, 1.0)

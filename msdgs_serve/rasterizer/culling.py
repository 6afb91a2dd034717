"""Find the blocks of static Gaussians that can't touch the drawn part of an image; they aren't read."""

import math

import numpy as np

from msdgs_serve.rasterizer.jit import kernel
from msdgs_serve.rasterizer.view import FISHEYE, ORTHOGRAPHIC, View
from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.scene.static_bounds import BLOCK, StaticBounds

MARGIN = 1.0
"""Pixels added to the reach of a block, for what the projection rounds."""
STRETCH = 1.01
"""Factor of the reach: quaternions and cameras that are valid may lengthen axes by a factor of 1.0053."""
LARGEST_EXTENT = 1e15
"""Pixels. Blocks of larger splats are always read: their extents may overflow in the projection."""


def seen_blocks(bounds: StaticBounds, view: View, count: int) -> np.ndarray:
    """Return which blocks of `count` Gaussians may be seen, [ceil(count / BLOCK)] uint8."""
    seen = np.ones(-(-count // BLOCK), np.uint8)
    if len(bounds.sizes) != max(len(seen) - bounds.first, 0):
        expected = f"bounds of the Gaussians that are drawn, {len(seen)} blocks of {BLOCK} with those that move"
        raise InvalidInput("static", expected, f"{bounds.first + len(bounds.sizes)} blocks")
    if view.model != FISHEYE:
        _test_boxes(bounds.boxes, bounds.sizes, view, seen[bounds.first :])
    return seen


@kernel
def _test_boxes(boxes: np.ndarray, sizes: np.ndarray, view: View, seen: np.ndarray) -> None:
    """Set blocks to 0 that are behind the near plane or beyond a side of the drawn part of the image.

    A Gaussian is beyond the left side if u + extent < left. For a pinhole camera that is fx x + (cx + extent - left) z
    < 0, which is linear in its position, so that its maximum over a box is at a corner.
    """
    r, t = view.rotation, view.translation
    reach = -2 * math.log(2) * view.log2_alpha_min
    slope_x, slope_y = max(-view.min_x, view.max_x), max(-view.min_y, view.max_y)
    stretch_x, stretch_y = view.fx * math.sqrt(1 + slope_x * slope_x), view.fy * math.sqrt(1 + slope_y * slope_y)
    if view.model == ORTHOGRAPHIC:
        stretch_x, stretch_y = view.fx, view.fy
    for k in range(len(boxes)):
        box = boxes[k]
        x = r[0][0] * box[0] + r[0][1] * box[1] + r[0][2] * box[2] + t[0]
        y = r[1][0] * box[0] + r[1][1] * box[1] + r[1][2] * box[2] + t[1]
        z = r[2][0] * box[0] + r[2][1] * box[1] + r[2][2] * box[2] + t[2]
        depth = _half_width(r, 0.0, 0.0, 1.0, box)
        if z + depth <= 0.999 * view.near_plane:
            seen[k] = 0
            continue
        scale = 1.0 if view.model == ORTHOGRAPHIC else 1 / max(z - depth, view.near_plane)
        size = sizes[k] * scale
        extent_x = STRETCH * math.sqrt(reach * ((stretch_x * size) ** 2 + view.eps2d)) + MARGIN
        extent_y = STRETCH * math.sqrt(reach * ((stretch_y * size) ** 2 + view.eps2d)) + MARGIN
        if not max(extent_x, extent_y) < LARGEST_EXTENT:
            continue
        sides = (
            (view.fx, 0.0, view.cx + extent_x - view.left),
            (-view.fx, 0.0, view.right + extent_x - view.cx),
            (0.0, view.fy, view.cy + extent_y - view.top),
            (0.0, -view.fy, view.bottom + extent_y - view.cy),
        )
        for of_x, of_y, offset in sides:
            if view.model == ORTHOGRAPHIC:
                highest = of_x * x + of_y * y + offset + _half_width(r, of_x, of_y, 0.0, box)
            else:
                highest = of_x * x + of_y * y + offset * z + _half_width(r, of_x, of_y, offset, box)
            if highest < 0:
                seen[k] = 0
                break


@kernel
def _half_width(r: tuple, of_x: float, of_y: float, of_z: float, box: np.ndarray) -> float:
    """Return by how much of_x x + of_y y + of_z z, in camera axes, exceeds its value at the center of a box."""
    total = 0.0
    for axis in range(3):
        total += abs(of_x * r[0][axis] + of_y * r[1][axis] + of_z * r[2][axis]) * box[3 + axis]
    return total

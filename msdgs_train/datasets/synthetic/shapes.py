"""Shapes of the synthetic scene at rest: signed distances and colors, as scalar kernels."""

import math

import numpy as np

from msdgs_serve.rasterizer.jit import kernel
from msdgs_train.datasets.synthetic import motion

GROUND, FRAME, BALL, RING, JELLY, PENDULUM = range(len(motion.OBJECTS))
GROUND_ROUNDING = 0.02
JELLY_ROUNDING = 0.07
DOTS, DOTS_UP = motion.JELLY_HALF_WIDTH / 1.5, motion.JELLY_HEIGHT / 3.5  # spacing that puts dots on the faces
POST_HEIGHT = motion.PIVOT_Z - motion.GROUND_Z

PALETTE = np.array(
    [
        [0.90, 0.87, 0.80],  # 0 cream
        [0.36, 0.47, 0.55],  # 1 slate
        [0.20, 0.27, 0.34],  # 2 night
        [0.90, 0.25, 0.20],  # 3 red
        [0.97, 0.77, 0.20],  # 4 yellow
        [0.13, 0.45, 0.80],  # 5 blue
        [0.05, 0.60, 0.55],  # 6 teal
        [0.97, 0.52, 0.18],  # 7 orange
        [0.58, 0.22, 0.62],  # 8 purple
        [0.96, 0.66, 0.80],  # 9 pink
        [0.93, 0.70, 0.25],  # 10 gold
        [0.25, 0.26, 0.28],  # 11 steel
    ]
)
"""[colors, 3] sRGB in [0, 1]; each field of a surface's pattern has one color."""


@kernel
def distance_at_rest(shape: int, x: float, y: float, z: float) -> float:
    """Return the signed distance from a point to object `shape` at rest, in scene units; negative inside."""
    if shape == GROUND:
        return _rounded_disc(x, y, z)
    if shape == FRAME:
        posts = _bar(abs(x) - motion.FRAME_HALF_WIDTH, y, z, POST_HEIGHT, motion.BAR_RADIUS)
        return min(posts, _bar(y, z - POST_HEIGHT, abs(x), motion.FRAME_HALF_WIDTH, motion.BAR_RADIUS))
    if shape == BALL:
        return math.sqrt(x * x + y * y + z * z) - motion.BALL_RADIUS
    if shape == RING:
        return math.hypot(math.hypot(x, y) - motion.RING_RADIUS, z) - motion.RING_TUBE
    if shape == JELLY:
        return _rounded_box(x, y, z)
    bob = math.sqrt(x * x + y * y + (z + motion.ROD_LENGTH) ** 2) - motion.BOB_RADIUS
    return min(bob, _bar(x, y, -z, motion.ROD_LENGTH, motion.ROD_RADIUS))


@kernel
def color_at_rest(shape: int, x: float, y: float, z: float) -> int:
    """Return the row of `PALETTE` at a point on the surface of object `shape`, given at rest."""
    if shape == GROUND:
        return _tile(x, y)
    if shape == FRAME:
        return 11
    if shape == BALL:
        if abs(z) > 0.93 * motion.BALL_RADIUS:
            return 2
        field = int((math.atan2(y, x) / math.pi + 1) * 3)
        return 3 if field == 0 else 4 if field == 2 else 5 if field == 4 else 0
    if shape == RING:
        around = math.atan2(y, x) / math.pi
        tube = math.atan2(z, math.hypot(x, y) - motion.RING_RADIUS) / math.pi
        if math.floor(4 * around + tube) % 2 == 0:
            return 0
        return 7 if around > 0 else 6
    if shape == JELLY:
        dot = math.sqrt(_to_lattice(x, DOTS) ** 2 + _to_lattice(y, DOTS) ** 2 + _to_lattice(z, DOTS_UP) ** 2)
        return 9 if dot < 0.05 else 8
    if z > motion.BOB_RADIUS - motion.ROD_LENGTH:
        return 11
    return 3 if abs(z + motion.ROD_LENGTH) < 0.25 * motion.BOB_RADIUS else 10


@kernel
def _tile(x: float, y: float) -> int:
    """Return the color of the ground: square tiles, a few of them colored, inside a ring."""
    radius = math.hypot(x, y)
    if radius > 0.97:
        return 2
    if radius > 0.9:
        return 7
    i, j = math.floor(x / 0.22 + 0.5), math.floor(y / 0.22 + 0.5)
    lot = (i * 7 + j * 13 + i * j * 5) % 11
    if lot == 3:
        return 6
    if lot == 7:
        return 4
    return 0 if (i + j) % 2 == 0 else 1


@kernel
def _rounded_disc(x: float, y: float, z: float) -> float:
    across = math.hypot(x, y) - (motion.GROUND_RADIUS - GROUND_ROUNDING)
    along = abs(z + 0.5 * motion.GROUND_THICKNESS) - (0.5 * motion.GROUND_THICKNESS - GROUND_ROUNDING)
    return math.hypot(max(across, 0.0), max(along, 0.0)) + min(max(across, along), 0.0) - GROUND_ROUNDING


@kernel
def _rounded_box(x: float, y: float, z: float) -> float:
    a = abs(x) - (motion.JELLY_HALF_WIDTH - JELLY_ROUNDING)
    b = abs(y) - (motion.JELLY_HALF_WIDTH - JELLY_ROUNDING)
    c = abs(z - 0.5 * motion.JELLY_HEIGHT) - (0.5 * motion.JELLY_HEIGHT - JELLY_ROUNDING)
    outside = math.sqrt(max(a, 0.0) ** 2 + max(b, 0.0) ** 2 + max(c, 0.0) ** 2)
    return outside + min(max(a, b, c), 0.0) - JELLY_ROUNDING


@kernel
def _bar(x: float, y: float, along: float, length: float, radius: float) -> float:
    """Return the signed distance to a round bar with round ends, from 0 to `length`."""
    beyond = along - min(max(along, 0.0), length)
    return math.sqrt(x * x + y * y + beyond * beyond) - radius


@kernel
def _to_lattice(value: float, spacing: float) -> float:
    """Return the distance to the nearest of the points spacing · (k + 1/2)."""
    return abs(value - spacing * (math.floor(value / spacing) + 0.5))

"""The motion of the synthetic scene: the position of each material point at each time.

World axes: z up, scene units, content within 1.25 of the origin. A point of an object at rest (`local`, [3]) has the
world position `offset + matrix · warp(local)`; `warp` twists around z and bends along x and y, both growing with z.
"""

import math
from typing import NamedTuple

import numpy as np

OBJECTS = ("ground", "frame", "ball", "ring", "jelly", "pendulum")
"""All objects, in the order of the rows of `Motion`. The ground and the frame are static."""

GROUND_Z = -0.5
GROUND_RADIUS, GROUND_THICKNESS = 1.1, 0.09
PIVOT_Z, FRAME_HALF_WIDTH, BAR_RADIUS = 0.7, 0.27, 0.02
BALL_RADIUS = 0.19
RING_RADIUS, RING_TUBE = 0.27, 0.095
JELLY_HALF_WIDTH, JELLY_HEIGHT = 0.2, 0.5
ROD_LENGTH, ROD_RADIUS, BOB_RADIUS = 0.74, 0.014, 0.12

BOUNCES = 3
BOUNCE_HEIGHT = 0.6
CONTACT = 0.1
"""Fraction of a bounce during which the ball touches the ground."""
SQUASH = 4 * BOUNCE_HEIGHT * CONTACT / ((1 - CONTACT) * math.pi * BALL_RADIUS)
"""Depth of the squash as a fraction of the radius, so that the velocity is continuous at contact."""


def _box(half_x: float, half_y: float, bottom: float, top: float) -> list[list[float]]:
    return [[-half_x, -half_y, bottom], [half_x, half_y, top]]


REST_BOXES = np.array(
    [
        _box(GROUND_RADIUS, GROUND_RADIUS, -GROUND_THICKNESS, 0),
        _box(FRAME_HALF_WIDTH + BAR_RADIUS, BAR_RADIUS, -BAR_RADIUS, PIVOT_Z - GROUND_Z + BAR_RADIUS),
        _box(BALL_RADIUS, BALL_RADIUS, -BALL_RADIUS, BALL_RADIUS),
        _box(RING_RADIUS + RING_TUBE, RING_RADIUS + RING_TUBE, -RING_TUBE, RING_TUBE),
        _box(JELLY_HALF_WIDTH, JELLY_HALF_WIDTH, 0, JELLY_HEIGHT),
        _box(BOB_RADIUS, BOB_RADIUS, -ROD_LENGTH - BOB_RADIUS, 2 * ROD_RADIUS),
    ]
)
"""[objects, 2, 3] opposite corners of a box around each object at rest."""

_UNIT_GRID = np.stack(np.meshgrid(*[np.linspace(0, 1, 5)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
_BOUND_MARGIN = 1.03  # the grid does not hit the farthest point of a bent box exactly


class Motion(NamedTuple):
    """All objects at one time, a row each, float64. Passed to the ray-marching kernels."""

    offsets: np.ndarray  # [objects, 3]
    matrices: np.ndarray  # [objects, 3, 3]
    inverses: np.ndarray  # [objects, 3, 3] inverses of `matrices`
    warps: np.ndarray  # [objects, 3]: twist in radians per unit of z, bend along x and along y in 1 / unit
    shrinks: np.ndarray  # [objects] lower bound of the ratio of world distances to distances at rest
    centers: np.ndarray  # [objects, 3] center of a sphere in the world around the object
    radii: np.ndarray  # [objects] radius of that sphere


def motion_at(t: float) -> Motion:
    """Return the state of the whole scene at time t in [0, 1]."""
    placements = _placements(t)
    boxes = REST_BOXES[:, :1] + _UNIT_GRID * (REST_BOXES[:, 1:] - REST_BOXES[:, :1])
    outlines = np.stack([_place(placement, box) for placement, box in zip(placements, boxes, strict=True)])
    centers = outlines.mean(axis=1)
    radii = np.linalg.norm(outlines - centers[:, None], axis=2).max(axis=1) * _BOUND_MARGIN
    offsets, matrices, warps = (np.stack(column) for column in zip(*placements, strict=True))
    return Motion(offsets, matrices, np.linalg.inv(matrices), warps, _shrinks(matrices, warps), centers, radii)


def world_positions(name: str, local: np.ndarray, t: float) -> np.ndarray:
    """Return the true world positions at time t of points of object `name`, which are given at rest, [..., 3]."""
    return _place(_placements(t)[OBJECTS.index(name)], np.asarray(local, float))


class _Placement(NamedTuple):
    offset: np.ndarray  # [3]
    matrix: np.ndarray  # [3, 3]
    warp: np.ndarray  # [3]


def _placements(t: float) -> tuple[_Placement, ...]:
    """Return the placement of each of `OBJECTS` at time t."""
    no_warp = np.zeros(3)
    ground = _Placement(np.array([0.0, 0.0, GROUND_Z]), np.eye(3), no_warp)
    jelly = _Placement(np.array([0.6, 0.34, GROUND_Z]), *_jelly(t))
    swing = _rotation(0, 0.72 * math.cos(3 * math.pi * t))
    pendulum = _Placement(np.array([0.0, 0.0, PIVOT_Z]), swing, no_warp)
    return ground, ground, _Placement(*_ball(t), no_warp), _Placement(*_ring(t), no_warp), jelly, pendulum


def _place(placement: _Placement, local: np.ndarray) -> np.ndarray:
    offset, matrix, (twist, bend_x, bend_y) = placement
    x, y, z = np.moveaxis(local, -1, 0)
    cos, sin = np.cos(twist * z), np.sin(twist * z)
    warped = np.stack([cos * x - sin * y + bend_x * z * z, sin * x + cos * y + bend_y * z * z, z], axis=-1)
    return offset + warped @ matrix.T


def _ball(t: float) -> tuple[np.ndarray, np.ndarray]:
    """Return offset and matrix: it bounces along an arc and spins; on the ground it is squashed at constant volume."""
    phase = (t * BOUNCES + 0.5) % 1.0
    height, flat = BALL_RADIUS, 1.0
    if phase < CONTACT:
        flat = 1 - SQUASH * math.sin(math.pi * phase / CONTACT)
        height *= flat
    else:
        flight = (phase - CONTACT) / (1 - CONTACT)
        height += 4 * BOUNCE_HEIGHT * flight * (1 - flight)
    around = math.radians(-155 + 130 * t)
    offset = np.array([0.78 * math.cos(around), 0.78 * math.sin(around), GROUND_Z + height])
    squash = np.diag([flat**-0.5, flat**-0.5, flat])
    return offset, squash @ _rotation(2, around) @ _rotation(0, -2.5 * math.pi * t) @ _rotation(1, 0.5)


def _ring(t: float) -> tuple[np.ndarray, np.ndarray]:
    """Return offset and matrix: it floats, and rotates around the vertical and around its own axis."""
    offset = np.array([-0.6, 0.34, 0.06 + 0.06 * math.sin(2 * math.pi * t)])
    return offset, _rotation(2, 2 * math.pi * t) @ _rotation(0, 1.15) @ _rotation(2, -2 * math.pi * t)


def _jelly(t: float) -> tuple[np.ndarray, np.ndarray]:
    """Return matrix and warp: it stretches at constant volume, twists and bends; its base stays on the ground."""
    stretch = 1 + 0.32 * math.sin(4 * math.pi * t)
    warp = np.array([2.4 * math.sin(3 * math.pi * t), 0.7 * math.sin(2 * math.pi * t + 1), 0.5 * math.cos(4 * t)])
    return np.diag([stretch**-0.5, stretch**-0.5, stretch]), warp


def _shrinks(matrices: np.ndarray, warps: np.ndarray) -> np.ndarray:
    smallest = np.linalg.svd(matrices, compute_uv=False)[:, -1]
    twist = 1 + np.abs(warps[:, 0]) * math.sqrt(2) * JELLY_HALF_WIDTH
    bend = 1 + 2 * np.hypot(warps[:, 1], warps[:, 2]) * JELLY_HEIGHT
    return smallest / (twist * bend)


def _rotation(axis: int, angle: float) -> np.ndarray:
    """Return the right-handed rotation around a coordinate axis, [3, 3]."""
    rotation = np.eye(3)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    rotation[i, i] = rotation[j, j] = math.cos(angle)
    rotation[j, i] = math.sin(angle)
    rotation[i, j] = -rotation[j, i]
    return rotation

"""Known motion of the synthetic scene: trajectories of material points on its surfaces."""

from typing import Any

import numpy as np

from msdgs_serve.rasterizer.jit import kernel
from msdgs_train.datasets.synthetic.motion import OBJECTS, REST_BOXES, world_positions
from msdgs_train.datasets.synthetic.shapes import PALETTE, color_at_rest, distance_at_rest

ROUNDS = 30
STEP = 1e-5  # step of the finite differences, scene units
DIGITS = 7


def surface_points(name: str, count: int, seed: int = 0) -> np.ndarray:
    """Return [count, 3] points scattered over the surface of object `name` at rest."""
    shape = OBJECTS.index(name)
    low, high = REST_BOXES[shape]
    points = np.random.default_rng(seed).uniform(low, high, size=(count, 3))
    _onto_surface(shape, points)
    return points


def surface_colors(name: str, local: np.ndarray) -> np.ndarray:
    """Return [N, 3] sRGB albedo in [0, 1] at points of object `name` at rest."""
    return PALETTE[[color_at_rest(OBJECTS.index(name), *point) for point in local]]


def trajectories(points_per_object: int, times: np.ndarray, seed: int = 0) -> dict[str, Any]:
    """Return plain values for JSON: `times`, and `points` with object, local [3], color [3], positions [times][3]."""
    points = []
    for name in OBJECTS:
        local = surface_points(name, points_per_object, seed)
        positions = np.stack([world_positions(name, local, float(t)) for t in times], axis=1)
        points += [
            {"object": name, "local": p.tolist(), "color": c.tolist(), "positions": w.tolist()}
            for p, c, w in zip(local.round(DIGITS), surface_colors(name, local), positions.round(DIGITS), strict=True)
        ]
    return {"times": times.tolist(), "points": points}


@kernel
def _onto_surface(shape: int, points: np.ndarray) -> None:
    """Move [N, 3] points onto the surface in place, by Newton's method along the gradient of the signed distance."""
    for point in points:
        for _ in range(ROUNDS):
            x, y, z = point
            distance = distance_at_rest(shape, x, y, z)
            gx = (distance_at_rest(shape, x + STEP, y, z) - distance) / STEP
            gy = (distance_at_rest(shape, x, y + STEP, z) - distance) / STEP
            gz = (distance_at_rest(shape, x, y, z + STEP) - distance) / STEP
            step = distance / max(gx * gx + gy * gy + gz * gz, 1e-12)
            point[0] -= step * gx
            point[1] -= step * gy
            point[2] -= step * gz

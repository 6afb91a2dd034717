"""Kernels that scale quaternions to unit length, and their gradients; 16 at a time."""

import numpy as np

from msdgs_serve.rasterizer.jit import inlined_kernel, kernel
from msdgs_serve.rasterizer.simd.memory import load_four_columns, store_columns
from msdgs_serve.rasterizer.simd.types import NUM_LANES, Vector
from msdgs_serve.rasterizer.simd.vectors import filled, select, square_root
from msdgs_serve.scene.quaternion import MIN_NORM


@kernel
def unit_forward(raw: np.ndarray, units: np.ndarray) -> None:
    """Write [N, 4] quaternions of unit length, or the identity if `raw` has no direction."""
    for first in range(0, len(raw), NUM_LANES):
        w, x, y, z = load_four_columns(raw, first, 0)
        factor = _inverse_norm(w, x, y, z)
        w = select(factor > 0, factor * w, filled(1, w))
        store_columns(units, first, 0, (w, factor * x, factor * y, factor * z))


@kernel
def unit_backward(raw: np.ndarray, grads: np.ndarray, grad_raw: np.ndarray) -> None:
    """Write the gradients of the quaternions before scaling, [N, 4]; 0 for those that became the identity."""
    for first in range(0, len(raw), NUM_LANES):
        w, x, y, z = load_four_columns(raw, first, 0)
        a, b, c, d = load_four_columns(grads, first, 0)
        factor = _inverse_norm(w, x, y, z)
        radial = factor * factor * (w * a + x * b + y * c + z * d)
        columns = (a - radial * w, b - radial * x, c - radial * y, d - radial * z)
        store_columns(
            grad_raw,
            first,
            0,
            (factor * columns[0], factor * columns[1], factor * columns[2], factor * columns[3]),
        )


@inlined_kernel
def _inverse_norm(w: Vector, x: Vector, y: Vector, z: Vector) -> Vector:
    """One over the norms of quaternions, 0 for those that have no direction."""
    norm = square_root(w * w + x * x + y * y + z * z)
    return select(norm < MIN_NORM, filled(0, norm), 1 / norm)

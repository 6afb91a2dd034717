"""Kernels that scale quaternions to unit length, and their gradients."""

import math

import numpy as np

from msdgs_serve.rasterizer.jit import kernel
from msdgs_serve.scene.quaternion import MIN_NORM


@kernel
def unit_forward(raw: np.ndarray, units: np.ndarray, norms: np.ndarray) -> None:
    """Write [N, 4] quaternions of unit length, or the identity if `raw` has no direction, and the norms, [N]."""
    for n in range(np.uint64(len(raw))):
        w, x, y, z = raw[n, 0], raw[n, 1], raw[n, 2], raw[n, 3]
        norm = math.sqrt(w * w + x * x + y * y + z * z)
        norms[n] = norm
        if norm < MIN_NORM:
            w, x, y, z, norm = raw.dtype.type(1), 0 * x, 0 * y, 0 * z, raw.dtype.type(1)
        units[n, 0], units[n, 1], units[n, 2], units[n, 3] = w / norm, x / norm, y / norm, z / norm


@kernel
def unit_backward(units: np.ndarray, norms: np.ndarray, grads: np.ndarray, grad_raw: np.ndarray) -> None:
    """Write the gradients of the quaternions before scaling, [N, 4]; 0 for those that became the identity."""
    for n in range(np.uint64(len(units))):
        radial = grads.dtype.type(0)
        for i in range(4):
            radial += units[n, i] * grads[n, i]
        factor = 1 / norms[n] if norms[n] >= MIN_NORM else 0 * norms[n]
        for i in range(4):
            grad_raw[n, i] = factor * (grads[n, i] - radial * units[n, i])

"""Kernels of linear blend skinning of N Gaussians by M nodes, and of its gradients.

The motion of a node is `MOTION` numbers: a matrix A [3, 3] row by row, an offset o [3], a quaternion r [4] wxyz. Their
weighted sums over the nodes of a Gaussian with mean x, unit quaternion q and rotation R give its deltas:

- mean: A x + o - x,
- logarithms of scales: log max(|A R_j|, `MIN_STRETCH`),
- quaternion: r q / |r| - q.
"""

import math

import numpy as np

from msdgs_serve.rasterizer.geometry import rotation_columns
from msdgs_serve.rasterizer.jit import inlined_kernel, kernel
from msdgs_serve.rasterizer.projection_backward import quaternion_gradient
from msdgs_serve.rasterizer.vector_memory import load, store
from msdgs_serve.rasterizer.vectors import fma, spread, sums_of
from msdgs_serve.scene.quaternion import MIN_NORM

MAX_NEAREST = 8
"""Nodes that a Gaussian follows, at most."""
MOTION = 16
OFFSET, ROT = 9, 12
"""First columns of the offset and of the quaternion of a motion; the matrix is before them."""
MIN_STRETCH = 0.05
"""Lower bound of the factor by which the axes of a Gaussian are stretched."""
DELTAS = 10
"""Columns of the deltas per Gaussian: mean 3, logarithms of scales 3, quaternion 4."""


@kernel
def skin_forward(
    means: np.ndarray,
    quats: np.ndarray,
    weights: np.ndarray,
    ids: np.ndarray,
    motions: np.ndarray,
    start: int,
    stop: int,
    deltas: np.ndarray,
) -> None:
    """Write rows `start` to `stop` of deltas [N, DELTAS].

    Args: means [N, 3], quats [N, 4], weights and ids [N, F] of nodes, motions [M, MOTION].
    """
    blended, flat = np.empty(MOTION, means.dtype), motions.reshape(-1)
    for n in range(np.uint64(start), np.uint64(stop)):
        _blend(weights, ids, flat, n, blended)
        matrix, rot, _ = _parts(blended)
        mean, quat = (means[n, 0], means[n, 1], means[n, 2]), (quats[n, 0], quats[n, 1], quats[n, 2], quats[n, 3])
        moved, rotated = _times(matrix, mean), _product(rot, quat)
        axes = rotation_columns(*quat)
        for i in range(3):
            deltas[n, i] = moved[i] + blended[OFFSET + i] - mean[i]
            deltas[n, 3 + i] = 0.5 * math.log(max(_square(_times(matrix, axes[i])), MIN_STRETCH**2))
        for i in range(4):
            deltas[n, 6 + i] = rotated[i] - quat[i]


@kernel
def skin_backward(
    means: np.ndarray,
    quats: np.ndarray,
    weights: np.ndarray,
    ids: np.ndarray,
    motions: np.ndarray,
    grad_deltas: np.ndarray,
    start: int,
    stop: int,
    grad_means: np.ndarray,
    grad_quats: np.ndarray,
    grad_weights: np.ndarray,
    grad_motions: np.ndarray,
) -> None:
    """Add the gradients of rows `start` to `stop` to `grad_motions`, and write those of the rows themselves."""
    blended, grads, dots = np.empty(MOTION, means.dtype), np.empty(MOTION, means.dtype), np.empty(16, means.dtype)
    products, flat, grad_flat = (
        np.zeros(MAX_NEAREST * MOTION, means.dtype),
        motions.reshape(-1),
        grad_motions.reshape(-1),
    )
    g = grad_deltas
    for n in range(np.uint64(start), np.uint64(stop)):
        _blend(weights, ids, flat, n, blended)
        matrix, rot, norm = _parts(blended)
        mean, quat = (means[n, 0], means[n, 1], means[n, 2]), (quats[n, 0], quats[n, 1], quats[n, 2], quats[n, 3])
        grad_mean, grad_quat = (g[n, 0], g[n, 1], g[n, 2]), (g[n, 6], g[n, 7], g[n, 8], g[n, 9])
        axes = rotation_columns(*quat)
        grad_axis_0, grad_axis_1, grad_axis_2 = (
            _grad_stretched(matrix, axes[0], g[n, 3]),
            _grad_stretched(matrix, axes[1], g[n, 4]),
            _grad_stretched(matrix, axes[2], g[n, 5]),
        )
        for i in range(3):
            for j in range(3):
                grads[3 * i + j] = (
                    grad_mean[i] * mean[j]
                    + grad_axis_0[i] * axes[0][j]
                    + grad_axis_1[i] * axes[1][j]
                    + grad_axis_2[i] * axes[2][j]
                )
            grads[OFFSET + i] = grad_mean[i]
        transposed = _transposed(matrix)
        grad_back = _times(transposed, grad_mean)
        for i in range(3):
            grad_means[n, i] = grad_back[i] - grad_mean[i]
        grad_axes = _times(transposed, grad_axis_0), _times(transposed, grad_axis_1), _times(transposed, grad_axis_2)
        grad_quat_axes = quaternion_gradient(*quat, grad_axes)
        grad_quat_rotated = _product(_conjugate(rot), grad_quat)
        grad_rot = _product(grad_quat, _conjugate(quat))
        radial = rot[0] * grad_rot[0] + rot[1] * grad_rot[1] + rot[2] * grad_rot[2] + rot[3] * grad_rot[3]
        for i in range(4):
            grad_quats[n, i] = grad_quat_axes[i] + grad_quat_rotated[i] - grad_quat[i]
            grads[ROT + i] = (grad_rot[i] - rot[i] * radial) / norm
        grad = load(grads, 0)
        for k in range(np.uint64(weights.shape[1])):
            row = np.uint64(ids[n, k]) * np.uint64(MOTION)
            store(products, k * np.uint64(MOTION), grad * load(flat, row))
            store(grad_flat, row, fma(spread(weights[n, k]), grad, load(grad_flat, row)))
        store(dots, 0, sums_of(_eight(products)))
        for k in range(np.uint64(weights.shape[1])):
            grad_weights[n, k] = dots[k]


@inlined_kernel
def _blend(weights: np.ndarray, ids: np.ndarray, motions: np.ndarray, n: np.uint64, blended: np.ndarray) -> None:
    total = spread(weights.dtype.type(0))
    for k in range(np.uint64(weights.shape[1])):
        total = fma(spread(weights[n, k]), load(motions, np.uint64(ids[n, k]) * np.uint64(MOTION)), total)
    store(blended, 0, total)


@inlined_kernel
def _parts(blended: np.ndarray) -> tuple:
    """The matrix [3][3] of a blended motion, its unit quaternion, and the norm before."""
    b = blended
    norm = max(math.sqrt(b[12] * b[12] + b[13] * b[13] + b[14] * b[14] + b[15] * b[15]), b.dtype.type(MIN_NORM))
    rot = (b[12] / norm, b[13] / norm, b[14] / norm, b[15] / norm)
    return ((b[0], b[1], b[2]), (b[3], b[4], b[5]), (b[6], b[7], b[8])), rot, norm


@inlined_kernel
def _times(m: tuple, v: tuple) -> tuple:
    """A matrix [3][3] times a vector [3]."""
    return (
        m[0][0] * v[0] + m[0][1] * v[1] + m[0][2] * v[2],
        m[1][0] * v[0] + m[1][1] * v[1] + m[1][2] * v[2],
        m[2][0] * v[0] + m[2][1] * v[1] + m[2][2] * v[2],
    )


@inlined_kernel
def _transposed(m: tuple) -> tuple:
    return (m[0][0], m[1][0], m[2][0]), (m[0][1], m[1][1], m[2][1]), (m[0][2], m[1][2], m[2][2])


@inlined_kernel
def _square(v: tuple) -> float:
    return v[0] * v[0] + v[1] * v[1] + v[2] * v[2]


@inlined_kernel
def _grad_stretched(matrix: tuple, axis: tuple, grad: float) -> tuple:
    """The gradient in c = A R_j of log |c|, `grad` · c / |c|²; 0 if |c| is clamped."""
    c = _times(matrix, axis)
    square = _square(c)
    factor = grad / square if square > MIN_STRETCH**2 else 0 * square
    return factor * c[0], factor * c[1], factor * c[2]


@inlined_kernel
def _product(a: tuple, b: tuple) -> tuple:
    """The Hamilton product of two quaternions."""
    return (
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


@inlined_kernel
def _conjugate(quat: tuple) -> tuple:
    return quat[0], -quat[1], -quat[2], -quat[3]


@inlined_kernel
def _eight(rows: np.ndarray) -> tuple:
    """Eight vectors, stored one after the other."""
    return (
        load(rows, 0),
        load(rows, 16),
        load(rows, 32),
        load(rows, 48),
        load(rows, 64),
        load(rows, 80),
        load(rows, 96),
        load(rows, 112),
    )

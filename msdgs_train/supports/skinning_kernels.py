"""N Gaussians carried by the blends of motions that each follows, and the gradients of that.

A motion is `MOTION` numbers: a matrix A [3, 3] row by row, an offset o [3], a quaternion r [4] wxyz. Blended with the
weights of a Gaussian at x, of unit quaternion q and rotation R, they give

- A x + o - x, by how much its mean moves,
- log |A R_j|, by how much the logarithms of its scales grow, from `MIN_STRETCH` on,
- r q / |r| - q, by how much its quaternion changes.
"""

import math

import numpy as np

from msdgs_serve.rasterizer.jit import inlined_kernel, kernel
from msdgs_serve.rasterizer.lanes import fma, spread
from msdgs_serve.rasterizer.lanes_memory import load, store, sums_of
from msdgs_serve.rasterizer.projection import rotation_columns
from msdgs_serve.rasterizer.projection_backward import quaternion_gradient
from msdgs_serve.scene.quaternion import MIN_NORM

MAX_NEAREST = 8
"""Motions nearest to a Gaussian, that it may ever follow."""
MOTION = 16
OFFSET, TURN = 9, 12
"""Where the parts of a motion that follow the matrix begin."""
MIN_STRETCH = 0.05
"""Of a Gaussian's own axes."""
DELTAS = 10
"""Columns that a Gaussian changes by: mean 3, logarithms of scales 3, quaternion 4."""


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
    """Rows `start` to `stop` of deltas [N, DELTAS]; means [N, 3], quats [N, 4], weights and ids [N, F] of the motions
    [B, MOTION]."""
    blended, flat = np.empty(MOTION, means.dtype), motions.reshape(-1)
    for n in range(np.uint64(start), np.uint64(stop)):
        _blend(weights, ids, flat, n, blended)
        matrix, turn, _ = _parts(blended)
        mean, quat = (means[n, 0], means[n, 1], means[n, 2]), (quats[n, 0], quats[n, 1], quats[n, 2], quats[n, 3])
        moved, turned = _times(matrix, mean), _product(turn, quat)
        axes = rotation_columns(*quat)
        for i in range(3):
            deltas[n, i] = moved[i] + blended[OFFSET + i] - mean[i]
            deltas[n, 3 + i] = 0.5 * math.log(max(_square(_times(matrix, axes[i])), MIN_STRETCH**2))
        for i in range(4):
            deltas[n, 6 + i] = turned[i] - quat[i]


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
    """Add the gradients of rows `start` to `stop` to those of the motions, and set those of their own."""
    blended, pulls, found = np.empty(MOTION, means.dtype), np.empty(MOTION, means.dtype), np.empty(16, means.dtype)
    products, flat, grad_flat = (
        np.zeros(MAX_NEAREST * MOTION, means.dtype),
        motions.reshape(-1),
        grad_motions.reshape(-1),
    )
    g = grad_deltas
    for n in range(np.uint64(start), np.uint64(stop)):
        _blend(weights, ids, flat, n, blended)
        matrix, turn, norm = _parts(blended)
        mean, quat = (means[n, 0], means[n, 1], means[n, 2]), (quats[n, 0], quats[n, 1], quats[n, 2], quats[n, 3])
        on_mean, on_quat = (g[n, 0], g[n, 1], g[n, 2]), (g[n, 6], g[n, 7], g[n, 8], g[n, 9])
        axes = rotation_columns(*quat)
        on_0, on_1, on_2 = (
            _on_stretched(matrix, axes[0], g[n, 3]),
            _on_stretched(matrix, axes[1], g[n, 4]),
            _on_stretched(matrix, axes[2], g[n, 5]),
        )
        for i in range(3):
            for j in range(3):
                pulls[3 * i + j] = (
                    on_mean[i] * mean[j] + on_0[i] * axes[0][j] + on_1[i] * axes[1][j] + on_2[i] * axes[2][j]
                )
            pulls[OFFSET + i] = on_mean[i]
        transposed = _transposed(matrix)
        back = _times(transposed, on_mean)
        for i in range(3):
            grad_means[n, i] = back[i] - on_mean[i]
        on_axes = _times(transposed, on_0), _times(transposed, on_1), _times(transposed, on_2)
        of_axes = quaternion_gradient(*quat, on_axes)
        of_turned = _product(_conjugate(turn), on_quat)
        on_turn = _product(on_quat, _conjugate(quat))
        along = turn[0] * on_turn[0] + turn[1] * on_turn[1] + turn[2] * on_turn[2] + turn[3] * on_turn[3]
        for i in range(4):
            grad_quats[n, i] = of_axes[i] + of_turned[i] - on_quat[i]
            pulls[TURN + i] = (on_turn[i] - turn[i] * along) / norm
        pull = load(pulls, 0)
        for k in range(np.uint64(weights.shape[1])):
            place = np.uint64(ids[n, k]) * np.uint64(MOTION)
            store(products, k * np.uint64(MOTION), pull * load(flat, place))
            store(grad_flat, place, fma(spread(weights[n, k]), pull, load(grad_flat, place)))
        store(found, 0, sums_of(_eight(products)))
        for k in range(np.uint64(weights.shape[1])):
            grad_weights[n, k] = found[k]


@inlined_kernel
def _blend(weights: np.ndarray, ids: np.ndarray, motions: np.ndarray, n: np.uint64, blended: np.ndarray) -> None:
    total = spread(weights.dtype.type(0))
    for k in range(np.uint64(weights.shape[1])):
        total = fma(spread(weights[n, k]), load(motions, np.uint64(ids[n, k]) * np.uint64(MOTION)), total)
    store(blended, 0, total)


@inlined_kernel
def _parts(blended: np.ndarray) -> tuple:
    """The matrix [3][3] of a blend, its quaternion made unit, and what that was divided by."""
    b = blended
    norm = max(math.sqrt(b[12] * b[12] + b[13] * b[13] + b[14] * b[14] + b[15] * b[15]), b.dtype.type(MIN_NORM))
    turn = (b[12] / norm, b[13] / norm, b[14] / norm, b[15] / norm)
    return ((b[0], b[1], b[2]), (b[3], b[4], b[5]), (b[6], b[7], b[8])), turn, norm


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
def _on_stretched(matrix: tuple, axis: tuple, pull: float) -> tuple:
    """The gradient of c = A R_j from that of log |c|: c / |c|², and none where |c| is kept from vanishing."""
    c = _times(matrix, axis)
    square = _square(c)
    share = pull / square if square > MIN_STRETCH**2 else 0 * square
    return share * c[0], share * c[1], share * c[2]


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
    """Vectors that lie one after the other."""
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

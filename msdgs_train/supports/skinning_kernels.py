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
from msdgs_serve.rasterizer.simd.exponential import log2
from msdgs_serve.rasterizer.simd.memory import (
    load,
    load_columns,
    load_four_columns,
    load_triples,
    store,
    store_columns,
    store_rows,
)
from msdgs_serve.rasterizer.simd.types import NUM_LANES, Vector
from msdgs_serve.rasterizer.simd.vectors import filled, fma, maximum, select, spread, square_root, sums_of
from msdgs_serve.scene.quaternion import MIN_NORM

MAX_NEAREST = 8
"""Nodes that a Gaussian follows, at most."""
MOTION = 16
"""Numbers of a motion: matrix 9, offset 3, quaternion 4."""
MIN_STRETCH = 0.05
"""Lower bound of the factor by which the axes of a Gaussian are stretched."""


@kernel
def skin_forward(
    means: np.ndarray,
    quats: np.ndarray,
    weights: np.ndarray,
    ids: np.ndarray,
    motions: np.ndarray,
    start: int,
    stop: int,
    delta_means: np.ndarray,
    delta_scales: np.ndarray,
    delta_quats: np.ndarray,
) -> None:
    """Write rows `start` to `stop` of deltas of means and logarithms of scales, [N, 3], and quaternions, [N, 4].

    Args: means [N, 3], quats [N, 4], weights [F, N] and ids [N, F] of nodes, motions [M, MOTION].
    """
    flat, blended = motions.reshape(-1), np.empty((NUM_LANES, MOTION), means.dtype)
    for first in range(start, stop, NUM_LANES):
        _blend(weights, ids, flat, first, blended)
        matrix, offset, rot, _ = _parts(blended)
        mean, quat = load_triples(means, first), load_four_columns(quats, first, 0)
        moved, rotated, axes = _times(matrix, mean), _product(rot, quat), rotation_columns(*quat)
        store_columns(
            delta_means,
            first,
            0,
            (moved[0] + offset[0] - mean[0], moved[1] + offset[1] - mean[1], moved[2] + offset[2] - mean[2]),
        )
        store_columns(
            delta_scales,
            first,
            0,
            (
                _log_length(_times(matrix, axes[0])),
                _log_length(_times(matrix, axes[1])),
                _log_length(_times(matrix, axes[2])),
            ),
        )
        store_columns(
            delta_quats,
            first,
            0,
            (rotated[0] - quat[0], rotated[1] - quat[1], rotated[2] - quat[2], rotated[3] - quat[3]),
        )


@kernel
def skin_backward(
    means: np.ndarray,
    quats: np.ndarray,
    weights: np.ndarray,
    ids: np.ndarray,
    motions: np.ndarray,
    grad_delta_means: np.ndarray,
    grad_delta_scales: np.ndarray,
    grad_delta_quats: np.ndarray,
    start: int,
    stop: int,
    grad_means: np.ndarray,
    grad_quats: np.ndarray,
    grad_weights: np.ndarray,
    grad_motions: np.ndarray,
) -> None:
    """Add the gradients of rows `start` to `stop` to `grad_motions`, and write those of the rows themselves."""
    flat, blended = motions.reshape(-1), np.empty((NUM_LANES, MOTION), means.dtype)
    grad_rows, scratch = np.empty((NUM_LANES, MOTION), means.dtype), np.zeros(2 * MAX_NEAREST * MOTION, means.dtype)
    for first in range(start, stop, NUM_LANES):
        _blend(weights, ids, flat, first, blended)
        matrix, _, rot, norm = _parts(blended)
        mean, quat = load_triples(means, first), load_four_columns(quats, first, 0)
        axes = rotation_columns(*quat)
        grad_mean, grad_stretch = load_triples(grad_delta_means, first), load_triples(grad_delta_scales, first)
        grad_quat = load_four_columns(grad_delta_quats, first, 0)
        grad_axes = (
            _grad_log_length(_times(matrix, axes[0]), grad_stretch[0]),
            _grad_log_length(_times(matrix, axes[1]), grad_stretch[1]),
            _grad_log_length(_times(matrix, axes[2]), grad_stretch[2]),
        )
        transposed = _transposed(matrix)
        back = _times(transposed, grad_mean)
        store_columns(grad_means, first, 0, (back[0] - grad_mean[0], back[1] - grad_mean[1], back[2] - grad_mean[2]))
        grad_axes_before = (
            _times(transposed, grad_axes[0]),
            _times(transposed, grad_axes[1]),
            _times(transposed, grad_axes[2]),
        )
        by_axes, by_product = quaternion_gradient(*quat, grad_axes_before), _product(_conjugate(rot), grad_quat)
        store_columns(
            grad_quats,
            first,
            0,
            (
                by_axes[0] + by_product[0] - grad_quat[0],
                by_axes[1] + by_product[1] - grad_quat[1],
                by_axes[2] + by_product[2] - grad_quat[2],
                by_axes[3] + by_product[3] - grad_quat[3],
            ),
        )
        grad_rot = _product(grad_quat, _conjugate(quat))
        radial = rot[0] * grad_rot[0] + rot[1] * grad_rot[1] + rot[2] * grad_rot[2] + rot[3] * grad_rot[3]
        store_rows(
            grad_rows,
            0,
            _outer_sums(0, grad_mean, mean, grad_axes, axes)
            + _outer_sums(1, grad_mean, mean, grad_axes, axes)
            + _outer_sums(2, grad_mean, mean, grad_axes, axes)
            + grad_mean
            + (
                (grad_rot[0] - rot[0] * radial) / norm,
                (grad_rot[1] - rot[1] * radial) / norm,
                (grad_rot[2] - rot[2] * radial) / norm,
                (grad_rot[3] - rot[3] * radial) / norm,
            ),
        )
        _to_nodes(first, stop, grad_rows, weights, ids, flat, scratch, grad_weights, grad_motions.reshape(-1))


@inlined_kernel
def _to_nodes(
    first: int,
    stop: int,
    grad_rows: np.ndarray,
    weights: np.ndarray,
    ids: np.ndarray,
    motions: np.ndarray,
    scratch: np.ndarray,
    grad_weights: np.ndarray,
    grad_motions: np.ndarray,
) -> None:
    """Add the gradients of 16 blended motions to those of the nodes, and write those of the weights."""
    dots = np.uint64(MAX_NEAREST * MOTION)
    for lane in range(np.uint64(min(NUM_LANES, stop - first))):
        n, grad = np.uint64(first) + lane, load(grad_rows.reshape(-1), lane * np.uint64(MOTION))
        for k in range(np.uint64(len(weights))):
            row = np.uint64(ids[n, k]) * np.uint64(MOTION)
            store(scratch, k * np.uint64(MOTION), grad * load(motions, row))
            store(grad_motions, row, fma(spread(weights[k, n]), grad, load(grad_motions, row)))
        store(scratch, dots, sums_of(_eight(scratch)))
        for k in range(np.uint64(len(weights))):
            grad_weights[k, n] = scratch[dots + k]


@inlined_kernel
def _blend(weights: np.ndarray, ids: np.ndarray, motions: np.ndarray, first: int, blended: np.ndarray) -> None:
    """Write the weighted sums of the motions of 16 Gaussians, [16, MOTION]; past the last one it is repeated."""
    flat, last = blended.reshape(-1), np.uint64(len(ids) - 1)
    for lane in range(np.uint64(NUM_LANES)):
        n, total = min(np.uint64(first) + lane, last), spread(weights.dtype.type(0))
        for k in range(np.uint64(len(weights))):
            total = fma(spread(weights[k, n]), load(motions, np.uint64(ids[n, k]) * np.uint64(MOTION)), total)
        store(flat, lane * np.uint64(MOTION), total)


@inlined_kernel
def _parts(blended: np.ndarray) -> tuple:
    """The matrices [3][3] of blended motions, offsets, unit quaternions, and the norms before."""
    b = load_columns(blended, 0)
    norm = square_root(b[12] * b[12] + b[13] * b[13] + b[14] * b[14] + b[15] * b[15])
    norm = maximum(norm, filled(MIN_NORM, norm))
    rot = (b[12] / norm, b[13] / norm, b[14] / norm, b[15] / norm)
    return ((b[0], b[1], b[2]), (b[3], b[4], b[5]), (b[6], b[7], b[8])), (b[9], b[10], b[11]), rot, norm


@inlined_kernel
def _outer_sums(i: int, grad_mean: tuple, mean: tuple, grad_axes: tuple, axes: tuple) -> tuple:
    """Row i of the gradient of the matrices: the sum of outer products of gradients and the vectors that they moved."""
    g, g0, g1, g2 = grad_mean[i], grad_axes[0][i], grad_axes[1][i], grad_axes[2][i]
    return (
        g * mean[0] + g0 * axes[0][0] + g1 * axes[1][0] + g2 * axes[2][0],
        g * mean[1] + g0 * axes[0][1] + g1 * axes[1][1] + g2 * axes[2][1],
        g * mean[2] + g0 * axes[0][2] + g1 * axes[1][2] + g2 * axes[2][2],
    )


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
def _square(v: tuple) -> Vector:
    return v[0] * v[0] + v[1] * v[1] + v[2] * v[2]


@inlined_kernel
def _log_length(v: tuple) -> Vector:
    """log max(|v|, MIN_STRETCH)."""
    square = _square(v)
    return 0.5 * math.log(2) * log2(maximum(square, filled(MIN_STRETCH**2, square)))


@inlined_kernel
def _grad_log_length(v: tuple, grad: Vector) -> tuple:
    """`grad` · v / |v|², or 0 where |v| is clamped."""
    square = _square(v)
    factor = select(square > filled(MIN_STRETCH**2, square), grad / square, filled(0, square))
    return factor * v[0], factor * v[1], factor * v[2]


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

"""Kernels of the features of six planes at N positions, and of their gradients.

At one time a plane over (axis, t) is a line over that axis, interpolated beforehand: three planes of space and three
lines are read. A feature is the product of six interpolated values. Positions are in cells, from 0, the first node of a
grid of S nodes, to S − 1, the last; positions outside are clamped.
"""

import numpy as np

from msdgs_serve.rasterizer.jit import kernel


@kernel
def plane_features(
    space: np.ndarray, lines: np.ndarray, positions: np.ndarray, start: int, stop: int, features: np.ndarray
) -> None:
    """Write rows `start` to `stop` of features [N, C].

    Args: space [3, S, S, C] (xy, xz, yz), lines [3, S, C], positions [N, 3].
    """
    size, channels = space.shape[1], space.shape[3]
    cells = np.empty(3, np.int64)
    parts = np.empty(3, positions.dtype)
    values = np.empty((6, channels), positions.dtype)
    for n in range(start, stop):
        _locate(positions[n], size, cells, parts)
        _interpolate(space, lines, cells, parts, values)
        for c in range(channels):
            features[n, c] = values[0, c] * values[1, c] * values[2, c] * values[3, c] * values[4, c] * values[5, c]


@kernel
def plane_gradients(
    space: np.ndarray,
    lines: np.ndarray,
    positions: np.ndarray,
    grad_features: np.ndarray,
    start: int,
    stop: int,
    grad_space: np.ndarray,
    grad_lines: np.ndarray,
    grad_positions: np.ndarray,
) -> None:
    """Add the gradients of rows `start` to `stop` to those of the grids, and write those of their positions [N, 3]."""
    size, channels = space.shape[1], space.shape[3]
    cells = np.empty(3, np.int64)
    parts = np.empty(3, positions.dtype)
    values = np.empty((6, channels), positions.dtype)
    grads = np.empty((6, channels), positions.dtype)
    for n in range(start, stop):
        _locate(positions[n], size, cells, parts)
        _interpolate(space, lines, cells, parts, values)
        _grad_factors(values, grad_features[n], grads)
        grad_positions[n] = 0
        for plane in range(3):
            first, second = (0 if plane < 2 else 1), (1 if plane == 0 else 2)
            i, j, a, b = cells[first], cells[second], parts[first], parts[second]
            slope_a, slope_b = _plane_slopes(space[plane], i, j, a, b, grads[plane])
            _add_to_plane(grad_space[plane], i, j, a, b, grads[plane])
            grad_positions[n, first] += slope_a
            grad_positions[n, second] += slope_b
        for axis in range(3):
            i, a, grad = cells[axis], parts[axis], grads[3 + axis]
            slope = positions.dtype.type(0)
            for c in range(channels):
                slope += grad[c] * (lines[axis, i + 1, c] - lines[axis, i, c])
                grad_lines[axis, i, c] += (1 - a) * grad[c]
                grad_lines[axis, i + 1, c] += a * grad[c]
            grad_positions[n, axis] += slope
            if positions[n, axis] < 0 or positions[n, axis] > size - 1:
                grad_positions[n, axis] = 0


@kernel
def _locate(position: np.ndarray, size: int, cells: np.ndarray, parts: np.ndarray) -> None:
    """The cell [3] of a position, [3], and the fraction of the cell before it, [3] in [0, 1]."""
    for axis in range(3):
        inside = min(max(0, position[axis]), size - 1)  # in this order NaN becomes 0 instead of an index
        cells[axis] = min(int(inside), size - 2)
        parts[axis] = inside - cells[axis]


@kernel
def _interpolate(
    space: np.ndarray, lines: np.ndarray, cells: np.ndarray, parts: np.ndarray, values: np.ndarray
) -> None:
    """The six values of each channel, [6, C]."""
    channels = space.shape[3]
    for plane in range(3):
        first, second = (0 if plane < 2 else 1), (1 if plane == 0 else 2)
        i, j, a, b = cells[first], cells[second], parts[first], parts[second]
        w00, w01, w10, w11 = (1 - a) * (1 - b), (1 - a) * b, a * (1 - b), a * b
        low, high = space[plane, i], space[plane, i + 1]
        for c in range(channels):
            values[plane, c] = w00 * low[j, c] + w01 * low[j + 1, c] + w10 * high[j, c] + w11 * high[j + 1, c]
    for axis in range(3):
        i, a = cells[axis], parts[axis]
        for c in range(channels):
            values[3 + axis, c] = (1 - a) * lines[axis, i, c] + a * lines[axis, i + 1, c]


@kernel
def _grad_factors(values: np.ndarray, gradient: np.ndarray, grads: np.ndarray) -> None:
    """The gradients of six factors, [6, C], of products, [C]; without a division, since a factor may be 0."""
    for c in range(len(gradient)):
        g, v0, v1, v2 = gradient[c], values[0, c], values[1, c], values[2, c]
        v3, v4, v5 = values[3, c], values[4, c], values[5, c]
        before2, after3 = v0 * v1, v4 * v5
        before3, after2 = before2 * v2, v3 * after3
        grads[0, c] = g * v1 * v2 * after2
        grads[1, c] = g * v0 * v2 * after2
        grads[2, c] = g * before2 * after2
        grads[3, c] = g * before3 * after3
        grads[4, c] = g * before3 * v3 * v5
        grads[5, c] = g * before3 * v3 * v4


@kernel
def _plane_slopes(grid: np.ndarray, i: int, j: int, a: float, b: float, grad: np.ndarray) -> tuple[float, float]:
    """Derivatives along the first and the second axis of a plane, [S, S, C], summed over the channels."""
    slope_a = slope_b = 0 * a
    for c in range(len(grad)):
        v00, v01, v10, v11 = grid[i, j, c], grid[i, j + 1, c], grid[i + 1, j, c], grid[i + 1, j + 1, c]
        slope_a += grad[c] * ((1 - b) * (v10 - v00) + b * (v11 - v01))
        slope_b += grad[c] * ((1 - a) * (v01 - v00) + a * (v11 - v10))
    return slope_a, slope_b


@kernel
def _add_to_plane(grid: np.ndarray, i: int, j: int, a: float, b: float, grad: np.ndarray) -> None:
    for c in range(len(grad)):
        grid[i, j, c] += (1 - a) * (1 - b) * grad[c]
        grid[i, j + 1, c] += (1 - a) * b * grad[c]
        grid[i + 1, j, c] += a * (1 - b) * grad[c]
        grid[i + 1, j + 1, c] += a * b * grad[c]

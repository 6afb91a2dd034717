"""Kernels of a multi-resolution hash encoding of N points in the unit cube, and of its gradients.

A point is interpolated between the eight nodes around it in each of L grids, with smooth steps as weights. A node's row
of the table is its place in the grid, or a hash of its indices where the grid has more nodes than rows. Points outside
of the cube read zeros. Formulas of Grid4D (Xu et al. 2024), after Instant-NGP (Müller et al. 2022).
"""

from typing import NamedTuple

import numpy as np

from msdgs_serve.rasterizer.jit import kernel

CORNERS = 8
PRIMES = 2654435761, 805459861  # of the second and the third index; the first has 1
UINT32 = 0xFFFFFFFF  # hashes are of 32 bits


class Levels(NamedTuple):
    """L grids whose rows follow each other in a table."""

    scales: np.ndarray  # float32 [L, 3] side of the cube in cells, not whole
    nodes: np.ndarray  # int64 [L, 3] along each axis, 2 or more
    starts: np.ndarray  # int64 [L + 1] first row of each level, then the number of all rows
    hashed: np.ndarray  # bool [L] whether the grid has more nodes than rows

    @classmethod
    def between(cls, count: int, coarsest: tuple[int, ...], finest: tuple[int, ...], most_rows: int) -> "Levels":
        """Levels from `coarsest` to `finest`, nodes along three axes, in equal ratios, of at most `most_rows` each.

        Rounded as in Grid4D: its table is laid out in float64, its kernels scale in float32. A level that ends a
        rounding above a whole number has a node more in the kernel than in the table, and is hashed.
        """
        first, last = np.array(coarsest, np.float64), np.array(finest, np.float64)
        ratios = np.exp2(np.log2(last / first) / max(count - 1, 1))
        rows = [min(int(np.prod(np.ceil(first * ratios**level))), most_rows) for level in range(count)]
        octaves = np.log2(ratios.astype(np.float32).astype(np.float64)).astype(np.float32)
        exponents = np.arange(count, dtype=np.float32)[:, None] * octaves
        # by way of float64: exp2 of float32 differs between processors
        powers = np.exp2(exponents.astype(np.float64)).astype(np.float32)
        scales = powers * first.astype(np.float32) - np.float32(1)
        nodes = np.ceil(scales).astype(np.int64) + 1
        return cls(scales, nodes, np.concatenate([[0], np.cumsum(rows)]), np.prod(nodes, axis=1) > rows)


class Cell(NamedTuple):
    """The cell around a position."""

    first: np.ndarray  # int64 [3] its lowest node
    rows: np.ndarray  # int64 [8] of its nodes in the table; the first axis changes fastest
    shares: np.ndarray  # [2, 3] of lower and upper nodes by axis
    slopes: np.ndarray  # [3] of the shares of upper nodes
    weights: np.ndarray  # [8] of its nodes


@kernel
def hash_features(
    table: np.ndarray, levels: Levels, positions: np.ndarray, first: int, stop: int, features: np.ndarray
) -> None:
    """Write features [N, L, C] of the levels `first` to `stop`. Args: table [rows, C], positions [N, 3]."""
    cell = _new_cell(positions)
    for level in range(first, stop):
        for n in range(len(positions)):
            features[n, level] = 0
            if _locate(levels, level, positions[n], cell):
                _weigh(cell)
                for k in range(CORNERS):
                    for c in range(table.shape[1]):
                        features[n, level, c] += cell.weights[k] * table[cell.rows[k], c]


@kernel
def hash_gradients(
    levels: Levels, positions: np.ndarray, grad_features: np.ndarray, first: int, stop: int, grad_table: np.ndarray
) -> None:
    """Add the gradients of the levels `first` to `stop`, whose rows no other level has, to those of the table."""
    cell = _new_cell(positions)
    for level in range(first, stop):
        for n in range(len(positions)):
            if _locate(levels, level, positions[n], cell):
                _weigh(cell)
                for k in range(CORNERS):
                    for c in range(grad_table.shape[1]):
                        grad_table[cell.rows[k], c] += cell.weights[k] * grad_features[n, level, c]


@kernel
def hash_slopes(
    table: np.ndarray,
    levels: Levels,
    positions: np.ndarray,
    grad_features: np.ndarray,
    start: int,
    stop: int,
    grad_positions: np.ndarray,
) -> None:
    """Write rows `start` to `stop` of the gradients of positions, [N, 3]."""
    cell = _new_cell(positions)
    for n in range(start, stop):
        grad_positions[n] = 0
        for level in range(len(levels.nodes)):
            if not _locate(levels, level, positions[n], cell):
                continue
            for axis in range(3):
                low, high = cell.shares[0, axis], cell.shares[1, axis]
                cell.shares[0, axis], cell.shares[1, axis] = -cell.slopes[axis], cell.slopes[axis]
                _weigh(cell)
                cell.shares[0, axis], cell.shares[1, axis] = low, high
                for k in range(CORNERS):
                    for c in range(table.shape[1]):
                        slope = cell.weights[k] * table[cell.rows[k], c]
                        grad_positions[n, axis] += slope * grad_features[n, level, c]


@kernel
def _new_cell(positions: np.ndarray) -> Cell:
    """Arrays to be filled, of the precision of positions."""
    dtype = positions.dtype
    return Cell(
        np.empty(3, np.int64),
        np.empty(CORNERS, np.int64),
        np.empty((2, 3), dtype),
        np.empty(3, dtype),
        np.empty(CORNERS, dtype),
    )


@kernel
def _locate(levels: Levels, level: int, position: np.ndarray, cell: Cell) -> bool:
    """Fill all of a cell but its weights. False outside of the cube, and for NaN."""
    number = position.dtype.type
    for axis in range(3):
        if not (position[axis] >= 0 and position[axis] <= 1):
            return False
        scale = number(levels.scales[level, axis])
        place = position[axis] * scale
        cell.first[axis] = min(int(place), levels.nodes[level, axis] - 2)
        part = place - number(cell.first[axis])
        cell.shares[1, axis] = part * part * (number(3) - number(2) * part)
        cell.shares[0, axis] = number(1) - cell.shares[1, axis]
        cell.slopes[axis] = number(6) * part * (number(1) - part) * scale
    for k in range(CORNERS):
        x, y, z = cell.first[0] + (k & 1), cell.first[1] + (k >> 1 & 1), cell.first[2] + (k >> 2)
        cell.rows[k] = row_of(levels, level, x, y, z)
    return True


@kernel
def row_of(levels: Levels, level: int, x: int, y: int, z: int) -> int:
    """The row of a node of a level in the table; of many, given int64 arrays."""
    start = levels.starts[level]
    if not levels.hashed[level]:
        return start + x + levels.nodes[level, 0] * (y + levels.nodes[level, 1] * z)
    spread, size = (x ^ y * PRIMES[0] ^ z * PRIMES[1]) & UINT32, levels.starts[level + 1] - start
    if size & (size - 1) == 0:  # of two: the remainder is a mask, in a fifth of the time
        return start + (spread & (size - 1))
    return start + spread % size


@kernel
def _weigh(cell: Cell) -> None:
    """Products of the shares of the nodes."""
    for k in range(CORNERS):
        cell.weights[k] = cell.shares[k & 1, 0] * cell.shares[k >> 1 & 1, 1] * cell.shares[k >> 2, 2]

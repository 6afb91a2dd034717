"""The blocks of 4 × 4 pixels that a tile is divided into, and the test of which of them a splat touches."""

import numpy as np

from msdgs_serve.rasterizer.jit import kernel
from msdgs_serve.rasterizer.splats import EXTENT_X, LOG2_OPACITY, ROOT_A, ROOT_B, ROOT_C, X, Y
from msdgs_serve.rasterizer.vector_memory import load
from msdgs_serve.rasterizer.vector_types import NUM_LANES, Mask, Vector
from msdgs_serve.rasterizer.vectors import filled, fma, maximum, negative, spread
from msdgs_serve.rasterizer.view import TILE

BLOCKS = TILE * TILE // NUM_LANES
BLOCK_SIDE = 4
PIXELS = TILE * TILE
MIDDLE, HALF = 0.5 * BLOCK_SIDE, 0.5 * (BLOCK_SIDE - 1)
"""Pixels from a block's edge to its middle, and from there to its outermost pixel centres."""


@kernel
def grid_of_a_tile(like: np.ndarray) -> np.ndarray:
    """Where the 16 blocks of a tile begin, x then y, and where the 16 pixel centres of a block are, x then y.

    In pixels from the corner, in the dtype of `like`.
    """
    grid = np.empty(4 * NUM_LANES, like.dtype)
    for k in range(NUM_LANES):
        column, row = k % BLOCK_SIDE, k // BLOCK_SIDE
        grid[k], grid[NUM_LANES + k] = BLOCK_SIDE * column, BLOCK_SIDE * row
        grid[2 * NUM_LANES + k], grid[3 * NUM_LANES + k] = column + 0.5, row + 0.5
    return grid


@kernel
def place_in_tile(row: int, column: int) -> int:
    """Where a pixel of a tile is in the tile's state: block by block."""
    block = (row // BLOCK_SIDE) * BLOCK_SIDE + column // BLOCK_SIDE
    return block * NUM_LANES + (row % BLOCK_SIDE) * BLOCK_SIDE + column % BLOCK_SIDE


@kernel
def touched_blocks(record: np.ndarray, grid: np.ndarray, log2_alpha_min: float) -> Mask:
    """Which of the tile's blocks a splat touches, whose record has its place in the tile."""
    real = record.dtype.type
    middle_x, middle_y = load(grid, 0) + (real(MIDDLE) - record[X]), load(grid, 16) + (real(MIDDLE) - record[Y])
    a, b, c = spread(record[ROOT_A]), spread(record[ROOT_B]), spread(record[ROOT_C])
    reach = max_distance(spread(record[LOG2_OPACITY]), log2_alpha_min)
    return touches_block(middle_x, middle_y, a, b, c, reach, spread(record[EXTENT_X]))


@kernel
def max_distance(log2_opacity: Vector, log2_alpha_min: float) -> Vector:
    """The largest |root @ d|² at which alpha is `alpha_min` or more, and a little more for what rounding takes."""
    return (log2_opacity - log2_alpha_min) * (1 + 1e-3) + 1e-3


@kernel
def touches_block(
    middle_x: Vector, middle_y: Vector, a: Vector, b: Vector, c: Vector, reach: Vector, extent_x: Vector
) -> Mask:
    """Whether a block, whose middle is seen from a splat, may have a pixel centre within reach.

    The least of each of the two parts of |root @ d|² over the block, and the box of the ellipse: a few blocks too many
    in the corners, 2 % of all, for half the arithmetic of the least of the sum.
    """
    half, zero = filled(HALF, a), filled(0, a)
    p_least = maximum(-negative(fma(a, middle_x, b * middle_y)) - half * (a - negative(b)), zero)
    q_least = maximum(-negative(c * middle_y) - half * c, zero)
    return (fma(p_least, p_least, q_least * q_least) <= reach) & (-negative(middle_x) <= extent_x + half)

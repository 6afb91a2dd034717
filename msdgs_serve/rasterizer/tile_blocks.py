"""The blocks of 4 × 4 pixels that a tile is divided into, and the test of which of them a splat touches."""

import numpy as np

from msdgs_serve.rasterizer.jit import kernel
from msdgs_serve.rasterizer.simd.memory import load
from msdgs_serve.rasterizer.simd.types import NUM_LANES, Mask, Vector
from msdgs_serve.rasterizer.simd.vectors import filled, fma, maximum, negative, spread
from msdgs_serve.rasterizer.splats import EXTENT_X, LOG2_OPACITY, ROOT_A, ROOT_B, ROOT_C, X, Y
from msdgs_serve.rasterizer.view import TILE

BLOCKS = TILE * TILE // NUM_LANES
BLOCK_SIDE = 4
PIXELS = TILE * TILE
CENTER, HALF = 0.5 * BLOCK_SIDE, 0.5 * (BLOCK_SIDE - 1)
"""Pixels from a block's edge to its center, and from there to its outermost pixel centers."""


@kernel
def grid_of_a_tile(like: np.ndarray) -> np.ndarray:
    """Return the corners of a tile's 16 blocks, x then y, and the 16 pixel centers of a block, x then y.

    Both are in pixels from the upper left corner, in the dtype of `like`.
    """
    grid = np.empty(4 * NUM_LANES, like.dtype)
    for k in range(NUM_LANES):
        column, row = k % BLOCK_SIDE, k // BLOCK_SIDE
        grid[k], grid[NUM_LANES + k] = BLOCK_SIDE * column, BLOCK_SIDE * row
        grid[2 * NUM_LANES + k], grid[3 * NUM_LANES + k] = column + 0.5, row + 0.5
    return grid


@kernel
def place_in_tile(row: int, column: int) -> int:
    """Return the index of a pixel of a tile in the tile's state, which is stored block by block."""
    block = (row // BLOCK_SIDE) * BLOCK_SIDE + column // BLOCK_SIDE
    return block * NUM_LANES + (row % BLOCK_SIDE) * BLOCK_SIDE + column % BLOCK_SIDE


@kernel
def touched_blocks(record: np.ndarray, grid: np.ndarray, log2_alpha_min: float) -> Mask:
    """Return the mask of the tile's blocks that a splat touches. Its record is relative to the tile."""
    real = record.dtype.type
    center_x, center_y = load(grid, 0) + (real(CENTER) - record[X]), load(grid, 16) + (real(CENTER) - record[Y])
    a, b, c = spread(record[ROOT_A]), spread(record[ROOT_B]), spread(record[ROOT_C])
    reach = max_distance(spread(record[LOG2_OPACITY]), log2_alpha_min)
    return touches_block(center_x, center_y, a, b, c, reach, spread(record[EXTENT_X]))


@kernel
def max_distance(log2_opacity: Vector, log2_alpha_min: float) -> Vector:
    """Return the largest |root @ d|² at which alpha is at least `alpha_min`, plus a margin for rounding."""
    return (log2_opacity - log2_alpha_min) * (1 + 1e-3) + 1e-3


@kernel
def touches_block(
    center_x: Vector, center_y: Vector, a: Vector, b: Vector, c: Vector, reach: Vector, extent_x: Vector
) -> Mask:
    """Whether a block may have a pixel center with |root @ d|² <= `reach`; its center is relative to the splat.

    Tests the minima of the two terms of |root @ d|² over the block, and the bounding box of the ellipse. This accepts 2
    % more blocks than the minimum of the sum, for half the arithmetic.
    """
    half, zero = filled(HALF, a), filled(0, a)
    p_least = maximum(-negative(fma(a, center_x, b * center_y)) - half * (a - negative(b)), zero)
    q_least = maximum(-negative(c * center_y) - half * c, zero)
    return (fma(p_least, p_least, q_least * q_least) <= reach) & (-negative(center_x) <= extent_x + half)

"""The accumulated colors, alpha and depths of a tile: initialized before blending, written into the images after it."""

import numpy as np

from msdgs_serve.rasterizer.jit import inlined_kernel, kernel
from msdgs_serve.rasterizer.simd.memory import load, prefetch, store
from msdgs_serve.rasterizer.simd.squares import store_square, store_square_of_triples
from msdgs_serve.rasterizer.simd.types import NUM_LANES, Vector
from msdgs_serve.rasterizer.simd.vectors import negative, select, spread
from msdgs_serve.rasterizer.tile_blocks import BLOCK_SIDE, BLOCKS, PIXELS, place_in_tile
from msdgs_serve.rasterizer.view import TILE


@inlined_kernel
def clear_tile(state: np.ndarray, depths: tuple) -> None:
    """Set transmittance to 1, colors and the sum of depths to 0."""
    real = state.dtype.type
    for k in range(np.uint64(0), np.uint64(PIXELS), np.uint64(NUM_LANES)):
        store(state, k, spread(real(1)))
    for k in range(np.uint64(PIXELS), np.uint64((5 if len(depths) > 0 else 4) * PIXELS), np.uint64(NUM_LANES)):
        store(state, k, spread(real(0)))


@inlined_kernel
def prefetch_tile(width: int, x0: int, y0: int, rows: int, depths: tuple, pixels: tuple) -> None:
    """Prefetch the pixels that the tile is written to: rows of an image are a memory page apart."""
    rgb, alphas, depth = pixels
    for row in range(rows):
        start = (y0 + row) * width + x0
        for third in range(3):
            prefetch(rgb, 3 * start + third * TILE)
        prefetch(alphas, start)
        if len(depths) > 0:
            prefetch(depth, start)


@inlined_kernel
def _finish_block(block: np.uint64, state: np.ndarray, background: np.ndarray) -> tuple[Vector, Vector, Vector, Vector]:
    """Return red, green, blue and alpha of a block's pixels after blending."""
    offset = block * np.uint64(NUM_LANES)
    left = -negative(load(state, offset))
    red = load(state, offset + np.uint64(PIXELS)) + left * background[0]
    green = load(state, offset + np.uint64(2 * PIXELS)) + left * background[1]
    blue = load(state, offset + np.uint64(3 * PIXELS)) + left * background[2]
    return red, green, blue, 1 - left


@inlined_kernel
def _mean_depth(block: np.uint64, state: np.ndarray, alpha: Vector) -> Vector:
    """Return the mean depth of a block's pixels after blending."""
    depth = load(state, block * np.uint64(NUM_LANES) + np.uint64(4 * PIXELS)) / alpha
    return select(alpha > 0, depth, spread(state.dtype.type(np.inf)))


@inlined_kernel
def write_tile(
    width: int, x0: int, y0: int, state: np.ndarray, background: np.ndarray, depths: tuple, pixels: tuple
) -> None:
    """Write a tile into `pixels`, the flattened images of a frame."""
    rgb, alphas, depth = pixels
    for block in range(np.uint64(BLOCKS)):
        red, green, blue, alpha = _finish_block(block, state, background)
        column, row = np.int64(block % np.uint64(BLOCK_SIDE)), np.int64(block // np.uint64(BLOCK_SIDE))
        start = (y0 + BLOCK_SIDE * row) * width + x0 + BLOCK_SIDE * column
        store_square_of_triples(rgb, 3 * start, 3 * width, red, green, blue)
        store_square(alphas, start, width, alpha)
        if len(depths) > 0:
            store_square(depth, start, width, _mean_depth(block, state, alpha))


@kernel
def write_cut_tile(
    width: int, x0: int, y0: int, size: tuple, state: np.ndarray, background: np.ndarray, depths: tuple, pixels: tuple
) -> None:
    """Write a tile that extends beyond the image, of which `size` columns and rows are inside."""
    rgb, alphas, depth = pixels
    columns, rows = size
    for block in range(np.uint64(BLOCKS)):
        offset = block * np.uint64(NUM_LANES)
        red, green, blue, alpha = _finish_block(block, state, background)
        if len(depths) > 0:
            store(state, offset + np.uint64(4 * PIXELS), _mean_depth(block, state, alpha))
        store(state, offset, alpha)
        store(state, offset + np.uint64(PIXELS), red)
        store(state, offset + np.uint64(2 * PIXELS), green)
        store(state, offset + np.uint64(3 * PIXELS), blue)
    for row in range(rows):
        for column in range(columns):
            place, pixel = place_in_tile(row, column), (y0 + row) * width + x0 + column
            alphas[pixel] = state[place]
            for channel in range(3):
                rgb[3 * pixel + channel] = state[place + PIXELS * (1 + channel)]
            if len(depths) > 0:
                depth[pixel] = state[place + 4 * PIXELS]


@kernel
def copy_tile(width: int, x0: int, y0: int, size: tuple, depths: tuple, source: tuple, pixels: tuple) -> None:
    """Copy a tile, of which `size` columns and rows are inside, between the flattened images of two frames."""
    columns, rows = size
    for row in range(rows):
        start = np.uint64((y0 + row) * width + x0)
        for place in range(np.uint64(3) * start, np.uint64(3) * (start + np.uint64(columns))):
            pixels[0][place] = source[0][place]
        for place in range(start, start + np.uint64(columns)):
            pixels[1][place] = source[1][place]
        if len(depths) > 0:
            for place in range(start, start + np.uint64(columns)):
                pixels[2][place] = source[2][place]

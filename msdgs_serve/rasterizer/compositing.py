"""Alpha blending of the splats of each tile, front to back (equation 2).

A tile of 16 × 16 pixels is 16 blocks of 4 × 4, one `Lanes` each. Splats are taken 63 at a time: first each one's
ellipse is tested against all blocks at once, then each block blends the splats that touch it, its state in registers.
"""

from typing import NamedTuple

import numpy as np

from msdgs_serve.rasterizer.atomic import fetch_add
from msdgs_serve.rasterizer.exponential import exp2, exp2_polynomial
from msdgs_serve.rasterizer.jit import kernel
from msdgs_serve.rasterizer.lanes import (
    LANES,
    Lanes,
    Mask,
    bits_of,
    filled,
    first_of,
    fma,
    load,
    lowest_bit,
    mark,
    maximum,
    minimum,
    negative,
    pair,
    prefetch,
    second_of,
    select,
    spread,
    store,
    store_square,
    store_square_of_triples,
)
from msdgs_serve.rasterizer.projection import (
    BLUE,
    DEPTH,
    GREEN,
    LOG2_OPACITY,
    RECORD,
    RED,
    ROOT_A,
    ROOT_B,
    ROOT_C,
    SLOPE_X,
    SLOPE_Y,
    Splats,
    X,
    Y,
)
from msdgs_serve.rasterizer.tiles import TileLists
from msdgs_serve.rasterizer.view import TILE, RasterizerOptions
from msdgs_serve.threads import run_parallel, thread_count

BLOCKS = TILE * TILE // LANES
BLOCK_SIDE = 4
PIXELS = TILE * TILE
BATCH = 63
NOBODY = np.uint64(1 << BATCH)
TILES_A_TURN = 16
AHEAD = np.uint64(64)
"""Pairs between asking for a record and needing it; without it a frame of 1,000,000 splats takes 1.07x the time."""
TILES_A_ROUND = 4096
"""A megapixel: then the threads wait for each other, and who no longer wants the image may say so."""


class PixelLimits(NamedTuple):
    """The options that the inner loop needs, in its dtype."""

    log2_alpha_min: np.floating
    alpha_max: np.floating
    transmittance_min: np.floating
    exp2: tuple  # coefficients of its polynomial


def pixel_limits(options: RasterizerOptions, dtype: np.dtype) -> PixelLimits:
    """`options` as scalars of `dtype`, so that no float64 enters a float32 loop."""
    real = dtype.type
    polynomial = exp2_polynomial(5 if dtype == np.float32 else 12)
    return PixelLimits(
        real(np.log2(options.alpha_min)),
        real(options.alpha_max),
        real(options.transmittance_min),
        tuple(map(real, polynomial)),
    )


class Frame(NamedTuple):
    """What is drawn into; in the splats' dtype."""

    rgb: np.ndarray  # [H, W, 3] the background included
    alpha: np.ndarray  # [H, W] 1 - transmittance
    depth: np.ndarray  # [H, W] mean distance along the camera axis, infinite where alpha is 0
    median_depth: np.ndarray  # [H, W] of the splat that takes half of the light, else infinite; or [0, 0]: not drawn


def composite(
    splats: Splats,
    tiles: TileLists,
    width: int,
    height: int,
    background: np.ndarray,
    options: RasterizerOptions,
    *,
    median_depth: bool = False,
) -> Frame:
    """Blend the splats into an image."""
    dtype = splats.records.dtype
    rgb, alpha, depth = (np.empty((height, width, *more), dtype) for more in ((3,), (), ()))
    frame = Frame(rgb, alpha, depth, np.empty((height, width) if median_depth else (0, 0), dtype))
    wanted = (True,) if median_depth else ()
    limits = pixel_limits(options, dtype)
    count = len(tiles.offsets) - 1
    for first in range(0, count, TILES_A_ROUND):
        turn = np.array([first])
        past = min(first + TILES_A_ROUND, count)
        arguments = (turn, past, splats.records, tiles, limits, background, wanted, frame)
        run_parallel(_composite_tiles, [arguments] * thread_count())
    return frame


@kernel
def _composite_tiles(
    turn: np.ndarray,
    past: int,
    records: np.ndarray,
    tiles: TileLists,
    limits: PixelLimits,
    background: np.ndarray,
    median: tuple,
    frame: Frame,
) -> None:
    """Draw tiles, `TILES_A_TURN` of them at each turn, up to the tile `past`.

    `median` is (True,) or (): whether there is a median depth is known when this is compiled, and costs nothing if not.
    """
    state = np.empty(6 * PIXELS, records.dtype)
    batch = np.zeros((BATCH + 1) * RECORD, records.dtype)
    batch[np.uint64(BATCH * RECORD) + LOG2_OPACITY] = -np.inf
    origin = np.zeros(RECORD, records.dtype)
    grid = grid_of_a_tile(records)
    alive = np.empty(BLOCKS, np.bool_)
    touching = np.empty(BLOCKS, np.uint64)
    height, width = frame.alpha.shape
    flat, last = records.reshape(-1), np.uint64(max(len(tiles.splat_ids), 1) - 1)
    while True:
        first = fetch_add(turn, TILES_A_TURN)
        if first >= past:
            return
        for tile in range(first, min(first + TILES_A_TURN, past)):
            x0, y0 = TILE * (tile % tiles.columns), TILE * (tile // tiles.columns)
            origin[0], origin[1] = x0, y0
            _prefetch_tile(x0, y0, min(TILE, height - y0), frame)
            state[:PIXELS] = 1
            state[PIXELS : 5 * PIXELS] = 0
            state[5 * PIXELS :] = np.inf
            alive[:] = True
            for begin in range(tiles.offsets[tile], tiles.offsets[tile + 1], BATCH):
                many = min(BATCH, tiles.offsets[tile + 1] - begin)
                touching[:] = np.uint64(0)
                for k in range(np.uint64(many)):
                    entry = np.uint64(begin) + k
                    prefetch(flat, np.uint64(tiles.splat_ids[min(entry + AHEAD, last)]) * np.uint64(RECORD))
                    source = np.uint64(tiles.splat_ids[entry]) * np.uint64(RECORD)
                    place = k * np.uint64(RECORD)
                    store(batch, place, load(flat, source) - load(origin, 0))
                    mark(touching, k, touched_blocks(batch, place, grid, limits.log2_alpha_min))
                some = False
                for block in range(np.uint64(BLOCKS)):
                    if alive[block]:
                        bits = touching[block]
                        if bits != np.uint64(0):
                            alive[block] = _blend_block(block, bits, batch, grid, limits, median, state)
                        some |= alive[block]
                if not some:
                    break
            _write_tile(x0, y0, min(TILE, width - x0), min(TILE, height - y0), state, background, median, frame)


@kernel
def grid_of_a_tile(like: np.ndarray) -> np.ndarray:
    """Where the 16 blocks of a tile begin, x then y, and where the 16 pixel centres of a block are, x then y.

    In pixels from the corner, in the dtype of `like`.
    """
    grid = np.empty(4 * LANES, like.dtype)
    for k in range(LANES):
        column, row = k % BLOCK_SIDE, k // BLOCK_SIDE
        grid[k], grid[LANES + k] = BLOCK_SIDE * column, BLOCK_SIDE * row
        grid[2 * LANES + k], grid[3 * LANES + k] = column + 0.5, row + 0.5
    return grid


@kernel
def place_in_tile(row: int, column: int) -> int:
    """Where a pixel of a tile is in the tile's state: block by block."""
    block = (row // BLOCK_SIDE) * BLOCK_SIDE + column // BLOCK_SIDE
    return block * LANES + (row % BLOCK_SIDE) * BLOCK_SIDE + column % BLOCK_SIDE


@kernel
def _prefetch_tile(x0: int, y0: int, rows: int, frame: Frame) -> None:
    """Fetch what the tile will be written to while it is blended: a row's pixels are a page away from the next's."""
    width = frame.alpha.shape[1]
    rgb, alphas, depths = frame.rgb.reshape(-1), frame.alpha.reshape(-1), frame.depth.reshape(-1)
    for row in range(rows):
        start = (y0 + row) * width + x0
        for third in range(3):
            prefetch(rgb, 3 * start + third * TILE)
        prefetch(alphas, start)
        prefetch(depths, start)


@kernel
def touched_blocks(batch: np.ndarray, place: np.uint64, grid: np.ndarray, log2_alpha_min: float) -> Mask:
    """Which of the tile's blocks have a point in the ellipse in which the splat's alpha is `alpha_min` or more.

    Of a convex form's minima over a box that doesn't hold its centre, one lies on a side that faces the centre; on a
    line the form is least where the `SLOPE`s say, or at the end of the side that is nearest to that.
    """
    real = batch.dtype.type
    zero, side = spread(real(0)), real(BLOCK_SIDE)
    low_x, low_y = load(grid, 0) - batch[place + X], load(grid, 16) - batch[place + Y]
    high_x, high_y = low_x + side, low_y + side
    a, b, c = spread(batch[place + ROOT_A]), spread(batch[place + ROOT_B]), spread(batch[place + ROOT_C])
    near_x, near_y = maximum(low_x, minimum(high_x, zero)), maximum(low_y, minimum(high_y, zero))
    best_y = maximum(low_y, minimum(high_y, near_x * batch[place + SLOPE_Y]))
    best_x = maximum(low_x, minimum(high_x, near_y * batch[place + SLOPE_X]))
    p, q = fma(a, near_x, b * best_y), c * best_y
    r, s = fma(a, best_x, b * near_y), c * near_y
    least = minimum(fma(p, p, q * q), fma(r, r, s * s))
    reach = batch[place + LOG2_OPACITY] - log2_alpha_min
    return least <= reach * real(1.001) + real(1e-3)


@kernel
def _blend_block(
    block: np.uint64,
    bits: np.uint64,
    batch: np.ndarray,
    grid: np.ndarray,
    limits: PixelLimits,
    median: tuple,
    state: np.ndarray,
) -> bool:
    """Blend the splats of the batch that `bits` names into a block; whether any of its pixels is still open.

    The transmittance of a pixel that is done is kept with a minus sign.
    """
    real = batch.dtype.type
    lane = block * np.uint64(LANES)
    pixel_x, pixel_y = load(grid, 32) + grid[block], load(grid, 48) + grid[np.uint64(16) + block]
    sums = (
        load(state, lane),
        load(state, lane + np.uint64(PIXELS)),
        load(state, lane + np.uint64(2 * PIXELS)),
        load(state, lane + np.uint64(3 * PIXELS)),
        load(state, lane + np.uint64(4 * PIXELS)),
    )
    while bits != np.uint64(0):
        first, bits = _next(bits)
        second, bits = _next(bits)
        third, bits = _next(bits)
        fourth, bits = _next(bits)
        exponent = pair(
            pair(log2_alpha(batch, first, pixel_x, pixel_y), log2_alpha(batch, second, pixel_x, pixel_y)),
            pair(log2_alpha(batch, third, pixel_x, pixel_y), log2_alpha(batch, fourth, pixel_x, pixel_y)),
        )
        alpha = exp2(exponent, limits.exp2)
        alpha = minimum(alpha, filled(limits.alpha_max, alpha))
        alpha = select(exponent >= limits.log2_alpha_min, alpha, filled(0, alpha))
        one, two = first_of(alpha), second_of(alpha)
        sums = _blended(first_of(one), batch, first, limits, median, state, lane, sums)
        sums = _blended(second_of(one), batch, second, limits, median, state, lane, sums)
        sums = _blended(first_of(two), batch, third, limits, median, state, lane, sums)
        sums = _blended(second_of(two), batch, fourth, limits, median, state, lane, sums)
    left, red, green, blue, depth = sums
    store(state, lane, left)
    store(state, lane + np.uint64(PIXELS), red)
    store(state, lane + np.uint64(2 * PIXELS), green)
    store(state, lane + np.uint64(3 * PIXELS), blue)
    store(state, lane + np.uint64(4 * PIXELS), depth)
    return bits_of(left > real(0)) != np.uint64(0)


@kernel
def _keep_median(before: Lanes, after: Lanes, depth: float, state: np.ndarray, lane: np.uint64) -> None:
    """Where the light falls to a half or less between two transmittances, keep the depth."""
    place = lane + np.uint64(5 * PIXELS)
    crossed = (before > 0.5) & (negative(after) >= -0.5)
    kept = load(state, place)
    store(state, place, select(crossed, filled(depth, kept), kept))


@kernel
def log2_alpha(batch: np.ndarray, place: np.uint64, pixel_x: Lanes, pixel_y: Lanes) -> Lanes:
    dx, dy = pixel_x - batch[place + X], pixel_y - batch[place + Y]
    p = fma(spread(batch[place + ROOT_A]), dx, batch[place + ROOT_B] * dy)
    q = batch[place + ROOT_C] * dy
    return fma(-p, p, fma(-q, q, spread(batch[place + LOG2_OPACITY])))


@kernel
def _next(bits: np.uint64) -> tuple[np.uint64, np.uint64]:
    """Where the record of the lowest set bit is, or that of nobody, and the bits without it."""
    return lowest_bit(bits | NOBODY) * np.uint64(RECORD), bits & (bits - np.uint64(1))


@kernel
def _blended(
    alpha: Lanes,
    batch: np.ndarray,
    place: np.uint64,
    limits: PixelLimits,
    median: tuple,
    state: np.ndarray,
    lane: np.uint64,
    sums: tuple,
) -> tuple[Lanes, Lanes, Lanes, Lanes, Lanes]:
    """What is left of the light, red, green, blue and depth behind one more splat."""
    left, red, green, blue, depth = sums
    after = fma(-alpha, left, left)
    goes_on = after > limits.transmittance_min
    weight = select(goes_on, alpha * left, filled(0, left))
    after = select(goes_on, after, negative(left))
    if len(median) > 0:
        _keep_median(left, after, batch[place + DEPTH], state, lane)
    red = fma(weight, spread(batch[place + RED]), red)
    green = fma(weight, spread(batch[place + GREEN]), green)
    blue = fma(weight, spread(batch[place + BLUE]), blue)
    return after, red, green, blue, fma(weight, spread(batch[place + DEPTH]), depth)


@kernel
def _write_tile(
    x0: int,
    y0: int,
    columns: int,
    rows: int,
    state: np.ndarray,
    background: np.ndarray,
    median: tuple,
    frame: Frame,
) -> None:
    whole = rows == TILE and columns == TILE
    width = frame.alpha.shape[1]
    rgb, alphas, depths = frame.rgb.reshape(-1), frame.alpha.reshape(-1), frame.depth.reshape(-1)
    medians = frame.median_depth.reshape(-1)
    infinite = spread(state.dtype.type(np.inf))
    for block in range(np.uint64(BLOCKS)):
        lane = block * np.uint64(LANES)
        left = -negative(load(state, lane))
        red = load(state, lane + np.uint64(PIXELS)) + left * background[0]
        green = load(state, lane + np.uint64(2 * PIXELS)) + left * background[1]
        blue = load(state, lane + np.uint64(3 * PIXELS)) + left * background[2]
        alpha = 1 - left
        depth = select(alpha > 0, load(state, lane + np.uint64(4 * PIXELS)) / alpha, infinite)
        if whole:
            x, y = x0 + BLOCK_SIDE * (block % np.uint64(4)), y0 + BLOCK_SIDE * (block // np.uint64(4))
            start = np.int64(y) * width + np.int64(x)
            store_square_of_triples(rgb, 3 * start, 3 * width, red, green, blue)
            store_square(alphas, start, width, alpha)
            store_square(depths, start, width, depth)
            if len(median) > 0:
                store_square(medians, start, width, load(state, lane + np.uint64(5 * PIXELS)))
        else:
            store(state, lane, alpha)
            store(state, lane + np.uint64(PIXELS), red)
            store(state, lane + np.uint64(2 * PIXELS), green)
            store(state, lane + np.uint64(3 * PIXELS), blue)
            store(state, lane + np.uint64(4 * PIXELS), depth)
    if not whole:
        for row in range(rows):
            for column in range(columns):
                place = place_in_tile(row, column)
                frame.alpha[y0 + row, x0 + column] = state[place]
                for channel in range(3):
                    frame.rgb[y0 + row, x0 + column, channel] = state[place + PIXELS * (channel + 1)]
                frame.depth[y0 + row, x0 + column] = state[place + 4 * PIXELS]
                if len(median) > 0:
                    frame.median_depth[y0 + row, x0 + column] = state[place + 5 * PIXELS]

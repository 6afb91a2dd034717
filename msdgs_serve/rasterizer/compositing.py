"""Alpha blending of the splats of each tile, front to back (equation 2).

A tile of 16 × 16 pixels is 16 blocks of 4 × 4, one `Lanes` each. Splats are taken 64 at a time: first the ellipses of
16 at once are tested against each block, then each block blends the splats that touch it, its state in registers.
"""

from typing import NamedTuple

import numpy as np

from msdgs_serve.rasterizer.atomic import DONE, TAKEN, all_done, fetch_add
from msdgs_serve.rasterizer.exponential import exp2, exp2_polynomial
from msdgs_serve.rasterizer.jit import inlined_kernel, kernel
from msdgs_serve.rasterizer.lane_types import LANES, Lanes, Mask
from msdgs_serve.rasterizer.lanes import (
    bits_of,
    filled,
    first_of,
    fma,
    lowest_bit,
    maximum,
    minimum,
    negative,
    pair,
    second_of,
    select,
    spread,
)
from msdgs_serve.rasterizer.lanes_memory import (
    load,
    load_columns_of,
    prefetch,
    store,
    store_square,
    store_square_of_triples,
)
from msdgs_serve.rasterizer.projection import (
    BLUE,
    DEPTH,
    EXTENT_X,
    GREEN,
    LOG2_OPACITY,
    RECORD,
    RED,
    ROOT_A,
    ROOT_B,
    ROOT_C,
    Splats,
    X,
    Y,
)
from msdgs_serve.rasterizer.tiles import TileLists
from msdgs_serve.rasterizer.view import TILE, RasterizerOptions
from msdgs_serve.threads import run_together

BLOCKS = TILE * TILE // LANES
BLOCK_SIDE = 4
MIDDLE, HALF = 0.5 * BLOCK_SIDE, 0.5 * (BLOCK_SIDE - 1)
"""Pixels from a block's edge to its middle, and from there to its outermost pixel centres."""
PIXELS = TILE * TILE
BATCH = np.uint64(64)
"""Splats: as many as a number has bits. The records of the next batch are fetched meanwhile; without that a frame of
1,000,000 splats takes 1.07x the time."""
TILES_A_TURN = 16
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
    depth: np.ndarray  # [H, W] mean distance along the camera axis, infinite where alpha is 0; or [0, 0]: not drawn
    median_depth: np.ndarray  # [H, W] of the splat that takes half of the light, else infinite; or [0, 0]


def composite(
    splats: Splats,
    tiles: TileLists,
    width: int,
    height: int,
    background: np.ndarray,
    options: RasterizerOptions,
    *,
    depth: bool = False,
    median_depth: bool = False,
) -> Frame:
    """Blend the splats into an image; where the median depth is drawn, the mean is too."""
    dtype = splats.records.dtype
    depths = (True, True) if median_depth else (True,) if depth else ()
    mean, median = (np.empty((height, width) if len(depths) > k else (0, 0), dtype) for k in range(2))
    frame = Frame(np.empty((height, width, 3), dtype), np.empty((height, width), dtype), mean, median)
    limits = pixel_limits(options, dtype)
    count = len(tiles.offsets) - 1
    for first in range(0, count, TILES_A_ROUND):
        counters, past = np.array([first, first]), min(first + TILES_A_ROUND, count)
        run_together(_composite_tiles, (counters, past, splats.records, tiles, limits, background, depths, frame))
    return frame


@kernel
def _composite_tiles(
    counters: np.ndarray,
    past: int,
    records: np.ndarray,
    tiles: TileLists,
    limits: PixelLimits,
    background: np.ndarray,
    depths: tuple,
    frame: Frame,
) -> bool:
    """Draw tiles, `TILES_A_TURN` of them at each turn, up to the tile `past`; whether all of them are drawn.

    `depths` is (), (True,) or (True, True), none, the mean, the median too: which is known when this is compiled, and
    what isn't wanted costs nothing. The mean makes a frame of 10,000 at 400 × 400 take 1.03 to 1.07 times as long.
    """
    state = np.empty(6 * PIXELS, records.dtype)
    batch = np.empty(RECORD * int(BATCH), records.dtype)
    grid = grid_of_a_tile(records)
    alive = np.empty(BLOCKS, np.bool_)
    touching = np.empty(BLOCKS, np.uint64)
    height, width = frame.alpha.shape
    pixels = (frame.rgb.reshape(-1), frame.alpha.reshape(-1), frame.depth.reshape(-1), frame.median_depth.reshape(-1))
    flat, last = records.reshape(-1), np.uint64(max(len(tiles.splat_ids), 1) - 1)
    while True:
        first = fetch_add(counters, TAKEN, TILES_A_TURN)
        if first >= past:
            return all_done(counters, past)
        end_of_turn = min(first + TILES_A_TURN, past)
        for tile in range(first, end_of_turn):
            x0, y0 = TILE * (tile % tiles.columns), TILE * (tile // tiles.columns)
            _prefetch_tile(width, x0, y0, min(TILE, height - y0), depths, pixels)
            _begin_tile(state, depths)
            alive[:] = True
            entry, end = np.uint64(tiles.offsets[tile]), np.uint64(tiles.offsets[tile + 1])
            some = True
            while some and entry < end:
                for k in range(entry + BATCH, entry + BATCH + BATCH):
                    prefetch(flat, np.uint64(tiles.splat_ids[min(k, last)]) * np.uint64(RECORD))
                touching[:] = np.uint64(0)
                many = min(end - entry, BATCH)
                for k in range(np.uint64(0), many, np.uint64(LANES)):
                    columns = load_columns_of(records, tiles.splat_ids, entry + k)
                    _mark_touching(columns, x0, y0, limits, k, batch, touching)
                there = np.uint64(0xFFFFFFFFFFFFFFFF) >> (BATCH - many)
                some = False
                for block in range(np.uint64(BLOCKS)):
                    if alive[block]:
                        bits = touching[block] & there
                        if bits != np.uint64(0):
                            alive[block] = _blend_block(block, bits, batch, grid, limits, depths, state)
                        some |= alive[block]
                entry += BATCH
            columns, rows = min(TILE, width - x0), min(TILE, height - y0)
            if columns == TILE and rows == TILE:
                _write_tile(width, x0, y0, state, background, depths, pixels)
            else:
                _write_cut_tile(width, x0, y0, (columns, rows), state, background, depths, pixels)
        fetch_add(counters, DONE, end_of_turn - first)


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


@inlined_kernel
def _begin_tile(state: np.ndarray, depths: tuple) -> None:
    """All of the light is left, and nothing has been seen."""
    real = state.dtype.type
    for k in range(np.uint64(0), np.uint64(PIXELS), np.uint64(LANES)):
        store(state, k, spread(real(1)))
    for k in range(np.uint64(PIXELS), np.uint64((5 if len(depths) > 0 else 4) * PIXELS), np.uint64(LANES)):
        store(state, k, spread(real(0)))
    if len(depths) > 1:
        for k in range(np.uint64(5 * PIXELS), np.uint64(6 * PIXELS), np.uint64(LANES)):
            store(state, k, spread(real(np.inf)))


@inlined_kernel
def _prefetch_tile(width: int, x0: int, y0: int, rows: int, depths: tuple, pixels: tuple) -> None:
    """Fetch what the tile will be written to while it is blended: a row's pixels are a page away from the next's."""
    rgb, alphas, means, _ = pixels
    for row in range(rows):
        start = (y0 + row) * width + x0
        for third in range(3):
            prefetch(rgb, 3 * start + third * TILE)
        prefetch(alphas, start)
        if len(depths) > 0:
            prefetch(means, start)


@kernel
def touched_blocks(record: np.ndarray, grid: np.ndarray, log2_alpha_min: float) -> Mask:
    """Which of the tile's blocks a splat touches, whose record has its place in the tile."""
    real = record.dtype.type
    middle_x, middle_y = load(grid, 0) + (real(MIDDLE) - record[X]), load(grid, 16) + (real(MIDDLE) - record[Y])
    a, b, c = spread(record[ROOT_A]), spread(record[ROOT_B]), spread(record[ROOT_C])
    reach = _reach(spread(record[LOG2_OPACITY]), log2_alpha_min)
    return _touches(middle_x, middle_y, a, b, c, reach, spread(record[EXTENT_X]))


@kernel
def _mark_touching(
    columns: tuple, x0: int, y0: int, limits: PixelLimits, first: np.uint64, batch: np.ndarray, touching: np.ndarray
) -> None:
    """Write 16 splats, whose records' columns these are, into the batch from place `first`, and set the bits from
    `first` of each block that they touch."""
    real = batch.dtype.type
    x, y = columns[X] - real(x0), columns[Y] - real(y0)
    a, b, c = columns[ROOT_A], columns[ROOT_B], columns[ROOT_C]
    offset_p, offset_q = _offsets(x, y, a, b, c)
    store(batch, first + X * BATCH, offset_p)
    store(batch, first + Y * BATCH, offset_q)
    for column in range(int(ROOT_A), int(DEPTH) + 1):
        store(batch, first + np.uint64(column) * BATCH, columns[column])
    reach = _reach(columns[LOG2_OPACITY], limits.log2_alpha_min)
    for row in range(np.uint64(BLOCK_SIDE)):
        middle_y = real(BLOCK_SIDE) * real(row) + real(MIDDLE) - y
        for column in range(np.uint64(BLOCK_SIDE)):
            middle_x = real(BLOCK_SIDE) * real(column) + real(MIDDLE) - x
            touched = bits_of(_touches(middle_x, middle_y, a, b, c, reach, columns[EXTENT_X]))
            touching[row * np.uint64(BLOCK_SIDE) + column] |= touched << first


@kernel
def _reach(log2_opacity: Lanes, log2_alpha_min: float) -> Lanes:
    """The largest |root @ d|² at which alpha is `alpha_min` or more, and a little more for what rounding takes."""
    return (log2_opacity - log2_alpha_min) * (1 + 1e-3) + 1e-3


@kernel
def _touches(middle_x: Lanes, middle_y: Lanes, a: Lanes, b: Lanes, c: Lanes, reach: Lanes, extent_x: Lanes) -> Mask:
    """Whether a block, whose middle is seen from a splat, may have a pixel centre within reach.

    The least of each of the two parts of |root @ d|² over the block, and the box of the ellipse: a few blocks too many
    in the corners, 2 % of all, for half the arithmetic of the least of the sum.
    """
    half, zero = filled(HALF, a), filled(0, a)
    p_least = maximum(-negative(fma(a, middle_x, b * middle_y)) - half * (a - negative(b)), zero)
    q_least = maximum(-negative(c * middle_y) - half * c, zero)
    return (fma(p_least, p_least, q_least * q_least) <= reach) & (-negative(middle_x) <= extent_x + half)


@kernel
def _offsets(x: Lanes, y: Lanes, a: Lanes, b: Lanes, c: Lanes) -> tuple[Lanes, Lanes]:
    """root @ d at the tile's corner, for splats at (x, y) with the root [[a, b], [0, c]]."""
    return -fma(a, x, b * y), -(c * y)


@inlined_kernel
def _blend_block(
    block: np.uint64,
    bits: np.uint64,
    batch: np.ndarray,
    grid: np.ndarray,
    limits: PixelLimits,
    depths: tuple,
    state: np.ndarray,
) -> bool:
    """Blend the splats of the batch that `bits` names into a block; whether any of its pixels is still open.

    The transmittance of a pixel that is done is kept with a minus sign.
    """
    lane = block * np.uint64(LANES)
    pixel_x, pixel_y = load(grid, 32) + grid[block], load(grid, 48) + grid[np.uint64(16) + block]
    left = load(state, lane)
    sums = (
        left > filled(0, left),
        -negative(left),
        load(state, lane + np.uint64(PIXELS)),
        load(state, lane + np.uint64(2 * PIXELS)),
        load(state, lane + np.uint64(3 * PIXELS)),
        load(state, lane + np.uint64(4 * PIXELS)) if len(depths) > 0 else left,
    )
    second, third, fourth = _without_three(bits)
    while fourth != np.uint64(0):
        places = (lowest_bit(bits), lowest_bit(second), lowest_bit(third), lowest_bit(fourth))
        exponent = pair(
            pair(_exponent(batch, places[0], pixel_x, pixel_y), _exponent(batch, places[1], pixel_x, pixel_y)),
            pair(_exponent(batch, places[2], pixel_x, pixel_y), _exponent(batch, places[3], pixel_x, pixel_y)),
        )
        alpha = _alpha(exponent, limits)
        one, two = first_of(alpha), second_of(alpha)
        sums = _blended(first_of(one), batch, places[0], limits, depths, state, lane, sums)
        sums = _blended(second_of(one), batch, places[1], limits, depths, state, lane, sums)
        sums = _blended(first_of(two), batch, places[2], limits, depths, state, lane, sums)
        sums = _blended(second_of(two), batch, places[3], limits, depths, state, lane, sums)
        bits = _without_lowest(fourth)
        second, third, fourth = _without_three(bits)
    while bits != np.uint64(0):
        place = lowest_bit(bits)
        alpha = _alpha(_exponent(batch, place, pixel_x, pixel_y), limits)
        sums = _blended(alpha, batch, place, limits, depths, state, lane, sums)
        bits = _without_lowest(bits)
    open_, left, red, green, blue, depth = sums
    store(state, lane, select(open_, left, negative(left)))
    store(state, lane + np.uint64(PIXELS), red)
    store(state, lane + np.uint64(2 * PIXELS), green)
    store(state, lane + np.uint64(3 * PIXELS), blue)
    if len(depths) > 0:
        store(state, lane + np.uint64(4 * PIXELS), depth)
    return bits_of(open_) != np.uint64(0)


@kernel
def _without_lowest(bits: np.uint64) -> np.uint64:
    return bits & (bits - np.uint64(1))


@kernel
def _without_three(bits: np.uint64) -> tuple[np.uint64, np.uint64, np.uint64]:
    """The bits without the lowest one, without the lowest two, without the lowest three."""
    second = _without_lowest(bits)
    third = _without_lowest(second)
    return second, third, _without_lowest(third)


@kernel
def _exponent(batch: np.ndarray, k: np.uint64, pixel_x: Lanes, pixel_y: Lanes) -> Lanes:
    return log2_alpha(
        spread(batch[k + X * BATCH]),
        spread(batch[k + Y * BATCH]),
        spread(batch[k + ROOT_A * BATCH]),
        spread(batch[k + ROOT_B * BATCH]),
        spread(batch[k + ROOT_C * BATCH]),
        spread(batch[k + LOG2_OPACITY * BATCH]),
        pixel_x,
        pixel_y,
    )


@kernel
def _alpha(exponent: Lanes, limits: PixelLimits) -> Lanes:
    alpha = exp2(exponent, limits.exp2)
    alpha = minimum(alpha, filled(limits.alpha_max, alpha))
    return select(exponent >= limits.log2_alpha_min, alpha, filled(0, alpha))


@kernel
def log2_alpha(
    offset_p: Lanes, offset_q: Lanes, a: Lanes, b: Lanes, c: Lanes, log2_opacity: Lanes, pixel_x: Lanes, pixel_y: Lanes
) -> Lanes:
    """Of pixels, seen from the tile's corner, for which the splat has these offsets."""
    p, q = fma(a, pixel_x, fma(b, pixel_y, offset_p)), fma(c, pixel_y, offset_q)
    return fma(-p, p, fma(-q, q, log2_opacity))


@kernel
def exponent_of(record: np.ndarray) -> tuple[Lanes, Lanes, Lanes, Lanes, Lanes, Lanes]:
    """What `log2_alpha` takes before the pixels, of a single splat, whose record has its place in the tile."""
    a, b, c = spread(record[ROOT_A]), spread(record[ROOT_B]), spread(record[ROOT_C])
    p, q = _offsets(spread(record[X]), spread(record[Y]), a, b, c)
    return p, q, a, b, c, spread(record[LOG2_OPACITY])


@kernel
def _blended(
    alpha: Lanes,
    batch: np.ndarray,
    k: np.uint64,
    limits: PixelLimits,
    depths: tuple,
    state: np.ndarray,
    lane: np.uint64,
    sums: tuple,
) -> tuple[Mask, Lanes, Lanes, Lanes, Lanes, Lanes]:
    """Which pixels are open, and what is left of the light, red, green, blue and depth, behind one more splat."""
    open_, left, red, green, blue, depth = sums
    after = fma(-alpha, left, left)
    open_ = open_ & (after > limits.transmittance_min)
    weight = select(open_, alpha * left, filled(0, left))
    if len(depths) > 1:
        _keep_median(open_, left, after, batch[k + DEPTH * BATCH], state, lane)
    left = select(open_, after, left)
    red = fma(weight, spread(batch[k + RED * BATCH]), red)
    green = fma(weight, spread(batch[k + GREEN * BATCH]), green)
    blue = fma(weight, spread(batch[k + BLUE * BATCH]), blue)
    if len(depths) > 0:
        depth = fma(weight, spread(batch[k + DEPTH * BATCH]), depth)
    return open_, left, red, green, blue, depth


@kernel
def _keep_median(open_: Mask, before: Lanes, after: Lanes, depth: float, state: np.ndarray, lane: np.uint64) -> None:
    """Where the light falls to a half or less between two transmittances, keep the depth."""
    place = lane + np.uint64(5 * PIXELS)
    kept = load(state, place)
    store(state, place, select(open_ & (before > 0.5) & (after <= 0.5), filled(depth, kept), kept))


@inlined_kernel
def _finish_block(block: np.uint64, state: np.ndarray, background: np.ndarray) -> tuple[Lanes, Lanes, Lanes, Lanes]:
    """Red, green, blue and alpha of a block's pixels when all has been drawn."""
    lane = block * np.uint64(LANES)
    left = -negative(load(state, lane))
    red = load(state, lane + np.uint64(PIXELS)) + left * background[0]
    green = load(state, lane + np.uint64(2 * PIXELS)) + left * background[1]
    blue = load(state, lane + np.uint64(3 * PIXELS)) + left * background[2]
    return red, green, blue, 1 - left


@inlined_kernel
def _mean_depth(block: np.uint64, state: np.ndarray, alpha: Lanes) -> Lanes:
    """Of a block's pixels when all has been drawn."""
    depth = load(state, block * np.uint64(LANES) + np.uint64(4 * PIXELS)) / alpha
    return select(alpha > 0, depth, spread(state.dtype.type(np.inf)))


@inlined_kernel
def _write_tile(
    width: int, x0: int, y0: int, state: np.ndarray, background: np.ndarray, depths: tuple, pixels: tuple
) -> None:
    """Into `pixels`, the images of a frame as they lie in memory."""
    rgb, alphas, means, medians = pixels
    for block in range(np.uint64(BLOCKS)):
        red, green, blue, alpha = _finish_block(block, state, background)
        column, row = np.int64(block % np.uint64(BLOCK_SIDE)), np.int64(block // np.uint64(BLOCK_SIDE))
        start = (y0 + BLOCK_SIDE * row) * width + x0 + BLOCK_SIDE * column
        store_square_of_triples(rgb, 3 * start, 3 * width, red, green, blue)
        store_square(alphas, start, width, alpha)
        if len(depths) > 0:
            store_square(means, start, width, _mean_depth(block, state, alpha))
        if len(depths) > 1:
            store_square(medians, start, width, load(state, block * np.uint64(LANES) + np.uint64(5 * PIXELS)))


@kernel
def _write_cut_tile(
    width: int, x0: int, y0: int, size: tuple, state: np.ndarray, background: np.ndarray, depths: tuple, pixels: tuple
) -> None:
    """As `_write_tile`, of a tile of which the image has so many columns and rows."""
    rgb, alphas, means, medians = pixels
    columns, rows = size
    for block in range(np.uint64(BLOCKS)):
        lane = block * np.uint64(LANES)
        red, green, blue, alpha = _finish_block(block, state, background)
        if len(depths) > 0:
            store(state, lane + np.uint64(4 * PIXELS), _mean_depth(block, state, alpha))
        store(state, lane, alpha)
        store(state, lane + np.uint64(PIXELS), red)
        store(state, lane + np.uint64(2 * PIXELS), green)
        store(state, lane + np.uint64(3 * PIXELS), blue)
    for row in range(rows):
        for column in range(columns):
            place, pixel = place_in_tile(row, column), (y0 + row) * width + x0 + column
            alphas[pixel] = state[place]
            for channel in range(3):
                rgb[3 * pixel + channel] = state[place + PIXELS * (1 + channel)]
            if len(depths) > 0:
                means[pixel] = state[place + 4 * PIXELS]
            if len(depths) > 1:
                medians[pixel] = state[place + 5 * PIXELS]

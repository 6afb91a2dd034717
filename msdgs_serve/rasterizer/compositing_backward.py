"""Gradient of the blending. Runs front to back like the forward pass and repeats its arithmetic, so that it takes the
very decisions (which splat is drawn in which pixel) that the image was made with.

For a pixel with gradient g, the splat's share of the loss is s = color · g_rgb + g_alpha and
d loss / d alpha_i = T_i s_i - (what all splats behind it and the background add) / (1 - alpha_i).
"""

import numpy as np

from msdgs_serve.rasterizer.atomic import DONE, TAKEN, all_done, fetch_add
from msdgs_serve.rasterizer.compositing import (
    BLOCKS,
    PIXELS,
    TILES_A_TURN,
    Frame,
    PixelLimits,
    grid_of_a_tile,
    log2_alpha_of,
    pixel_limits,
    place_in_tile,
    touched_blocks,
)
from msdgs_serve.rasterizer.exponential import exp2
from msdgs_serve.rasterizer.jit import kernel
from msdgs_serve.rasterizer.lane_types import LANES
from msdgs_serve.rasterizer.lanes import bits_of, filled, fma, lowest_bit, minimum, negative, select, spread
from msdgs_serve.rasterizer.lanes_memory import load, prefetch, store, sums_of
from msdgs_serve.rasterizer.projection import (
    BLUE,
    GREEN,
    RECORD,
    RED,
    Splats,
    X,
    Y,
)
from msdgs_serve.rasterizer.tiles import TileLists
from msdgs_serve.rasterizer.view import TILE, RasterizerOptions
from msdgs_serve.threads import run_parallel, run_together, split_evenly, threads_to_use

# places in a tile's scratch: what is left of the light (with a minus sign where a pixel is done), the pixel's gradient,
# and what is still behind
LEFT, GRAD_RED, GRAD_GREEN, GRAD_BLUE, GRAD_ALPHA, BEHIND = (np.uint64(PIXELS * place) for place in range(6))
SUMS = LANES
"""Numbers of a pair of splat and tile, nine in use: red, green, blue, then the moments of d loss / d sigma about the
splat: 1, x, y, xx, xy, yy."""

AHEAD = np.uint64(16)
"""Pairs between asking for a record and needing it."""


def composite_backward(
    splats: Splats,
    tiles: TileLists,
    options: RasterizerOptions,
    frame: Frame,
    grad_rgb: np.ndarray,
    grad_alpha: np.ndarray,
) -> np.ndarray:
    """The sums of each splat, [N, SUMS]: zero where it isn't drawn.

    Args:
        frame: what `composite` drew; its depth is not looked at.
        grad_rgb: [H, W, 3].
        grad_alpha: [H, W].
    """
    records = splats.records
    pair_sums = np.empty((len(tiles.splat_ids), SUMS), records.dtype)
    seen = np.empty(len(tiles.offsets) - 1, np.int64)
    counters, limits = np.zeros(2, np.int64), pixel_limits(options, records.dtype)
    run_together(
        _tiles_backward,
        (counters, records, tiles, limits, frame.rgb, frame.alpha, grad_rgb, grad_alpha, pair_sums, seen),
    )
    sums = np.zeros((len(records), SUMS), records.dtype)
    run_parallel(_add_up, [(*part, tiles, seen, pair_sums, sums) for part in split_evenly(len(sums), threads_to_use())])
    return sums


@kernel
def _tiles_backward(
    counters: np.ndarray,
    records: np.ndarray,
    tiles: TileLists,
    limits: PixelLimits,
    rgb: np.ndarray,
    alpha: np.ndarray,
    grad_rgb: np.ndarray,
    grad_alpha: np.ndarray,
    pair_sums: np.ndarray,
    seen: np.ndarray,
) -> bool:
    """Write the sums of each pair of tile and splat, and how many pairs of a tile have been: those behind what hides
    them are left out. Whether all tiles are done."""
    count = len(tiles.offsets) - 1
    state = np.empty(6 * PIXELS, records.dtype)
    record = np.empty(RECORD, records.dtype)
    origin = np.zeros(RECORD, records.dtype)
    grid = grid_of_a_tile(records)
    height, width = alpha.shape
    flat, flat_sums = records.reshape(-1), pair_sums.reshape(-1)
    flat_rgb, flat_alpha = rgb.reshape(-1), alpha.reshape(-1)
    flat_grad_rgb, flat_grad_alpha = grad_rgb.reshape(-1), grad_alpha.reshape(-1)
    while True:
        first = fetch_add(counters, TAKEN, TILES_A_TURN)
        if first >= count:
            return all_done(counters, count)
        end_of_turn = min(first + TILES_A_TURN, count)
        for tile in range(first, end_of_turn):
            x0, y0 = TILE * (tile % tiles.columns), TILE * (tile // tiles.columns)
            origin[0], origin[1] = x0, y0
            state[:] = 0
            state[:PIXELS] = 1
            rows, columns = np.uint64(min(TILE, height - y0)), np.uint64(min(TILE, width - x0))
            for row in range(rows):
                line = np.uint64(y0 + row) * np.uint64(width) + np.uint64(x0)
                _prefetch_line(line + np.uint64(TILE), flat_rgb, flat_alpha, flat_grad_rgb, flat_grad_alpha)
                for column in range(columns):
                    pixel, there = place_in_tile(row, column), line + column
                    behind = flat_alpha[there] * flat_grad_alpha[there]
                    for channel in range(np.uint64(3)):
                        grad = flat_grad_rgb[np.uint64(3) * there + channel]
                        behind += flat_rgb[np.uint64(3) * there + channel] * grad
                        state[GRAD_RED + np.uint64(PIXELS) * channel + pixel] = grad
                    state[GRAD_ALPHA + pixel] = flat_grad_alpha[there]
                    state[BEHIND + pixel] = behind
            alive = np.uint64((1 << BLOCKS) - 1)
            first_pair, past = np.uint64(tiles.offsets[tile]), np.uint64(tiles.offsets[tile + 1])
            pair = first_pair
            while pair < past and alive != np.uint64(0):
                ahead = min(pair + AHEAD, past - np.uint64(1))
                prefetch(flat, np.uint64(tiles.splat_ids[ahead]) * np.uint64(RECORD))
                store(record, 0, load(flat, np.uint64(tiles.splat_ids[pair]) * np.uint64(RECORD)) - load(origin, 0))
                bits = alive & bits_of(touched_blocks(record, grid, limits.log2_alpha_min))
                alive &= ~_splat_backward(bits, record, grid, limits, state, flat_sums, pair * np.uint64(SUMS))
                pair += np.uint64(1)
            seen[tile] = pair - first_pair
        fetch_add(counters, DONE, end_of_turn - first)


@kernel
def _prefetch_line(
    start: np.uint64, rgb: np.ndarray, alpha: np.ndarray, grad_rgb: np.ndarray, grad_alpha: np.ndarray
) -> None:
    """Fetch a row of the next tile while this one is worked on: the rows are a page away from each other."""
    for place in range(np.uint64(3) * start, np.uint64(3) * (start + np.uint64(TILE)), np.uint64(LANES)):
        prefetch(rgb, place)
        prefetch(grad_rgb, place)
    prefetch(alpha, start)
    prefetch(grad_alpha, start)


@kernel
def _splat_backward(
    bits: np.uint64,
    record: np.ndarray,
    grid: np.ndarray,
    limits: PixelLimits,
    state: np.ndarray,
    sums: np.ndarray,
    place: np.uint64,
) -> np.uint64:
    """Write the sums of a splat over the blocks that `bits` names; returns those of them that are done now."""
    zero = spread(record.dtype.type(0))
    sum_red, sum_green, sum_blue = zero, zero, zero
    sum_1, sum_x, sum_y, sum_xx, sum_xy, sum_yy = zero, zero, zero, zero, zero, zero
    done = np.uint64(0)
    while bits != np.uint64(0):
        block = lowest_bit(bits)
        bits &= bits - np.uint64(1)
        lane = block * np.uint64(LANES)
        pixel_x, pixel_y = load(grid, 32) + grid[block], load(grid, 48) + grid[np.uint64(16) + block]
        dx, dy = pixel_x - record[X], pixel_y - record[Y]
        left = load(state, LEFT + lane)
        exponent = log2_alpha_of(record, pixel_x, pixel_y)
        raw_alpha = exp2(exponent, limits.exp2)
        uncut = raw_alpha < limits.alpha_max
        alpha = minimum(raw_alpha, filled(limits.alpha_max, raw_alpha))
        alpha = select(exponent >= limits.log2_alpha_min, alpha, zero)
        after = fma(-alpha, left, left)
        goes_on = after > limits.transmittance_min
        alpha = select(goes_on, alpha, zero)
        store(state, LEFT + lane, select(goes_on, after, negative(left)))
        weight = alpha * left
        grad_red, grad_green = load(state, GRAD_RED + lane), load(state, GRAD_GREEN + lane)
        grad_blue = load(state, GRAD_BLUE + lane)
        share = fma(grad_red, spread(record[RED]), load(state, GRAD_ALPHA + lane))
        share = fma(grad_blue, spread(record[BLUE]), fma(grad_green, spread(record[GREEN]), share))
        behind = fma(-weight, share, load(state, BEHIND + lane))
        store(state, BEHIND + lane, behind)
        grad_alpha = left * share - behind / (1 - alpha)
        # d alpha / d sigma = -alpha where the splat is drawn and not cut to alpha_max
        grad_sigma = select(uncut, -alpha * grad_alpha, zero)
        sum_red, sum_green = fma(weight, grad_red, sum_red), fma(weight, grad_green, sum_green)
        sum_blue = fma(weight, grad_blue, sum_blue)
        along_x, along_y = grad_sigma * dx, grad_sigma * dy
        sum_1, sum_x, sum_y = sum_1 + grad_sigma, sum_x + along_x, sum_y + along_y
        sum_xx, sum_xy, sum_yy = fma(along_x, dx, sum_xx), fma(along_x, dy, sum_xy), fma(along_y, dy, sum_yy)
        if bits_of(goes_on) == np.uint64(0):
            done |= np.uint64(1) << block
    moments = (sum_red, sum_green, sum_blue, sum_1, sum_x, sum_y, sum_xx, sum_xy, sum_yy)
    store(sums, place, sums_of(moments))
    return done


@kernel
def _add_up(start: int, stop: int, tiles: TileLists, seen: np.ndarray, pair_sums: np.ndarray, sums: np.ndarray) -> None:
    """Add up the tiles of splats `start` to `stop`, always in the same order."""
    flat_pairs, flat = pair_sums.reshape(-1), sums.reshape(-1)
    last = np.uint64(max(len(tiles.splat_ids), 1) - 1)
    for tile in range(np.uint64(len(seen))):
        first = np.uint64(tiles.offsets[tile])
        for pair in range(first, first + np.uint64(seen[tile])):
            prefetch(flat, np.uint64(tiles.splat_ids[min(pair + AHEAD, last)]) * np.uint64(SUMS))
            splat = np.uint64(tiles.splat_ids[pair])
            if np.uint64(start) <= splat and splat < np.uint64(stop):
                place = splat * np.uint64(SUMS)
                store(flat, place, load(flat, place) + load(flat_pairs, pair * np.uint64(SUMS)))

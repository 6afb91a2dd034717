"""Gradient of the blending. Runs front to back and repeats the arithmetic of the forward pass, so that it draws exactly
the same splats in each pixel.

For a pixel with gradient g, the splat's contribution to the loss is s = color · g_rgb + g_alpha and
d loss / d alpha_i = T_i s_i - (contributions of all splats behind it and the background) / (1 - alpha_i).
"""

import itertools
import math

import numpy as np

from msdgs_serve.rasterizer.alpha import PixelLimits, exponent_terms, log2_alpha, pixel_limits
from msdgs_serve.rasterizer.atomic import DONE, TAKEN, all_done, fetch_add
from msdgs_serve.rasterizer.compositing import TILES_PER_TURN, Frame
from msdgs_serve.rasterizer.jit import inlined_kernel, kernel
from msdgs_serve.rasterizer.simd.exponential import exp2
from msdgs_serve.rasterizer.simd.memory import load, prefetch, store
from msdgs_serve.rasterizer.simd.squares import load_square, load_square_of_triples
from msdgs_serve.rasterizer.simd.types import NUM_LANES
from msdgs_serve.rasterizer.simd.vectors import (
    bits_of,
    filled,
    fma,
    lowest_bit,
    minimum,
    negative,
    select,
    spread,
    sums_of,
)
from msdgs_serve.rasterizer.splats import BLUE, DEPTH, EXTENT_X, GREEN, RECORD, RED, ROOT_SCALE, Splats, X, Y
from msdgs_serve.rasterizer.tile_blocks import BLOCK_SIDE, BLOCKS, PIXELS, grid_of_a_tile, place_in_tile, touched_blocks
from msdgs_serve.rasterizer.tiles import TileLists
from msdgs_serve.rasterizer.view import TILE, RasterizerOptions
from msdgs_serve.threads import run_parallel, run_together, threads_to_use

# offsets in a tile's state: transmittance (0 if the pixel is finished), the pixel's gradient, the contribution of
# splats behind, and the pixel's position in the tile
LEFT, GRAD_RED, GRAD_GREEN, GRAD_BLUE, GRAD_ALPHA, BEHIND, PIXEL_X, PIXEL_Y = (
    np.uint64(PIXELS * place) for place in range(8)
)
SUMS = NUM_LANES
"""Numbers per pair of splat and tile: red, green, blue, the moments 1, x, y, xx, xy, yy of d loss / d sigma about the
splat's mean, and with `absolute` those of `ABSOLUTE`."""
ABSOLUTE = slice(9, 11)
"""Columns of the sums over pixels of |d loss / d x| and |d loss / d y| of the splat's mean, per pixel."""

PAIRS_PER_ROUND = 1 << 18
"""16 MB of sums; in one round of 1,400,000 pairs (85 MB) the gradient takes 1.1 times as long."""

DEPTH_SAMPLES = 1000
"""Depths that are sampled to divide the splats among threads."""
PREFETCH_DISTANCE = np.uint64(16)
"""Pairs between prefetch and use of a record."""


def composite_backward(
    splats: Splats,
    tiles: TileLists,
    options: RasterizerOptions,
    frame: Frame,
    grad_rgb: np.ndarray,
    grad_alpha: np.ndarray,
    *,
    absolute: bool = False,
) -> np.ndarray:
    """Return the sums of each splat, [N, SUMS], zero if it isn't drawn.

    Args:
        frame: the result of `composite`; its depths are not used.
        grad_rgb: [H, W, 3].
        grad_alpha: [H, W].
        absolute: also the sums of absolute gradients of the mean (AbsGS, Ye et al. 2024), in the columns `ABSOLUTE`.
    """
    records, limits = splats.records, pixel_limits(options, splats.records.dtype)
    rounds = _rounds(tiles.offsets)
    most = max((int(tiles.offsets[past] - tiles.offsets[first]) for first, past in rounds), default=0)
    pair_sums, seen = np.empty((most, SUMS), records.dtype), np.empty(len(tiles.offsets) - 1, np.int64)
    sums = np.zeros((len(records), SUMS), records.dtype)
    slices = list(itertools.pairwise(_depths_between(records, threads_to_use())))
    images = (frame.rgb, frame.alpha, grad_rgb, grad_alpha)
    absolutes = (True,) if absolute else ()
    for first, past in rounds:
        counters = np.array([first, first])
        arguments = (counters, first, past, records, tiles, limits, absolutes, images, pair_sums, seen)
        run_together(_tiles_backward, arguments)
        run_parallel(_add_up, [(*depths, first, past, records, tiles, seen, pair_sums, sums) for depths in slices])
    return sums


def _rounds(offsets: np.ndarray) -> list[tuple[int, int]]:
    """Return consecutive ranges (first, past) of tiles, of at most `PAIRS_PER_ROUND` pairs or a single tile each."""
    rounds, first, count = [], 0, len(offsets) - 1
    while first < count:
        past = int(np.searchsorted(offsets, offsets[first] + PAIRS_PER_ROUND, side="right")) - 1
        past = max(min(past, count), first + 1)
        rounds.append((first, past))
        first = past
    return rounds


def _depths_between(records: np.ndarray, parts: int) -> list[float]:
    """Return depths from -infinity to infinity that divide the splats into about equal `parts`, by a sample of them."""
    some = records[:: max(len(records) // DEPTH_SAMPLES, 1)]
    some = np.sort(some[some[:, EXTENT_X] > 0, DEPTH])
    return [-math.inf, *(float(some[len(some) * part // parts]) for part in range(1, parts) if len(some)), math.inf]


@kernel
def _tiles_backward(
    counters: np.ndarray,
    first_tile: int,
    past_tile: int,
    records: np.ndarray,
    tiles: TileLists,
    limits: PixelLimits,
    absolutes: tuple,
    images: tuple,
    pair_sums: np.ndarray,
    seen: np.ndarray,
) -> bool:
    """Write the sums of each pair of splat and tile, for tiles `first_tile` to `past_tile`, and into `seen` how many
    pairs of each tile were processed: those behind finished pixels are skipped. Return whether all these tiles are
    done.

    `absolutes` is (True,) if absolute gradients are summed, or (): its length is known at compile time. `images` are
    color, alpha, and the gradients of both.
    """
    state = np.empty(8 * PIXELS, records.dtype)
    record = np.empty(RECORD, records.dtype)
    origin = np.zeros(RECORD, records.dtype)
    grid = grid_of_a_tile(records)
    for block in range(np.uint64(BLOCKS)):
        store(state, PIXEL_X + block * np.uint64(NUM_LANES), load(grid, 32) + grid[block])
        store(state, PIXEL_Y + block * np.uint64(NUM_LANES), load(grid, 48) + grid[np.uint64(16) + block])
    rgb, alpha, grad_rgb, grad_alpha = images
    height, width = alpha.shape
    base = np.uint64(tiles.offsets[first_tile])
    flat, flat_sums = records.reshape(-1), pair_sums.reshape(-1)
    pixels = (rgb.reshape(-1), alpha.reshape(-1), grad_rgb.reshape(-1), grad_alpha.reshape(-1))
    while True:
        first = fetch_add(counters, TAKEN, TILES_PER_TURN)
        if first >= past_tile:
            return all_done(counters, past_tile)
        end_of_turn = min(first + TILES_PER_TURN, past_tile)
        for tile in range(first, end_of_turn):
            x0, y0 = TILE * (tile % tiles.columns), TILE * (tile // tiles.columns)
            origin[0], origin[1] = x0, y0
            columns, rows = min(TILE, width - x0), min(TILE, height - y0)
            if columns == TILE and rows == TILE:
                _load_tile(width, x0, y0, pixels, state)
            else:
                _load_cut_tile(width, x0, y0, (columns, rows), pixels, state)
            alive = np.uint64((1 << BLOCKS) - 1)
            first_pair, past = np.uint64(tiles.offsets[tile]), np.uint64(tiles.offsets[tile + 1])
            pair = first_pair
            while pair < past and alive != np.uint64(0):
                upcoming = min(pair + PREFETCH_DISTANCE, past - np.uint64(1))
                prefetch(flat, np.uint64(tiles.splat_ids[upcoming]) * np.uint64(RECORD))
                store(record, 0, load(flat, np.uint64(tiles.splat_ids[pair]) * np.uint64(RECORD)) - load(origin, 0))
                bits = alive & bits_of(touched_blocks(record, grid, limits.log2_alpha_min))
                place = (pair - base) * np.uint64(SUMS)
                alive &= ~_splat_backward(bits, record, limits, absolutes, state, flat_sums, place)
                pair += np.uint64(1)
            seen[tile] = pair - first_pair
        fetch_add(counters, DONE, end_of_turn - first)


@inlined_kernel
def _load_tile(width: int, x0: int, y0: int, pixels: tuple, state: np.ndarray) -> None:
    """Initialize the tile's state. Pixel by pixel, as in `_load_cut_tile`, a frame of 10,000 splats at 1920 × 1080
    takes 1.1 times as long."""
    rgb, alphas, grad_rgb, grad_alphas = pixels
    for block in range(np.uint64(BLOCKS)):
        offset = block * np.uint64(NUM_LANES)
        column, row = np.int64(block % np.uint64(BLOCK_SIDE)), np.int64(block // np.uint64(BLOCK_SIDE))
        start = (y0 + BLOCK_SIDE * row) * width + x0 + BLOCK_SIDE * column
        _prefetch_block(width, start + TILE, pixels)
        red, green, blue = load_square_of_triples(rgb, 3 * start, 3 * width)
        grad_red, grad_green, grad_blue = load_square_of_triples(grad_rgb, 3 * start, 3 * width)
        alpha, grad_alpha = load_square(alphas, start, width), load_square(grad_alphas, start, width)
        behind = fma(red, grad_red, fma(green, grad_green, fma(blue, grad_blue, alpha * grad_alpha)))
        store(state, LEFT + offset, filled(1, behind))
        store(state, GRAD_RED + offset, grad_red)
        store(state, GRAD_GREEN + offset, grad_green)
        store(state, GRAD_BLUE + offset, grad_blue)
        store(state, GRAD_ALPHA + offset, grad_alpha)
        store(state, BEHIND + offset, behind)


@kernel
def _load_cut_tile(width: int, x0: int, y0: int, size: tuple, pixels: tuple, state: np.ndarray) -> None:
    """Initialize the state of a tile that extends beyond the image, of which `size` columns and rows are inside."""
    rgb, alphas, grad_rgb, grad_alphas = pixels
    columns, rows = size
    state[:PIXEL_X] = 0  # pixels beyond the border count as finished
    for row in range(rows):
        for column in range(columns):
            place, pixel = np.uint64(place_in_tile(row, column)), (y0 + row) * width + x0 + column
            state[LEFT + place] = 1
            behind = alphas[pixel] * grad_alphas[pixel]
            for channel in range(np.uint64(3)):
                grad = grad_rgb[3 * pixel + channel]
                behind += rgb[3 * pixel + channel] * grad
                state[GRAD_RED + np.uint64(PIXELS) * channel + place] = grad
            state[GRAD_ALPHA + place] = grad_alphas[pixel]
            state[BEHIND + place] = behind


@inlined_kernel
def _prefetch_block(width: int, start: int, pixels: tuple) -> None:
    """Prefetch a block of the next tile: rows of an image are a memory page apart."""
    rgb, alphas, grad_rgb, grad_alphas = pixels
    for row in range(BLOCK_SIDE):
        pixel = start + row * width
        prefetch(rgb, 3 * pixel)
        prefetch(grad_rgb, 3 * pixel)
        prefetch(alphas, pixel)
        prefetch(grad_alphas, pixel)


@kernel
def _splat_backward(
    bits: np.uint64,
    record: np.ndarray,
    limits: PixelLimits,
    absolutes: tuple,
    state: np.ndarray,
    sums: np.ndarray,
    place: np.uint64,
) -> np.uint64:
    """Write the sums of a splat over the blocks whose `bits` are set. Return the mask of blocks that it finishes."""
    zero = spread(record.dtype.type(0))
    sum_red, sum_green, sum_blue = zero, zero, zero
    sum_1, sum_x, sum_y, sum_xx, sum_xy, sum_yy = zero, zero, zero, zero, zero, zero
    sum_abs_x, sum_abs_y = zero, zero
    done = np.uint64(0)
    # read once: to the compiler, the stores below may change the record
    x, y, terms = spread(record[X]), spread(record[Y]), exponent_terms(record)
    red, green, blue = spread(record[RED]), spread(record[GREEN]), spread(record[BLUE])
    while bits != np.uint64(0):
        block = lowest_bit(bits)
        bits &= bits - np.uint64(1)
        offset = block * np.uint64(NUM_LANES)
        pixel_x, pixel_y = load(state, PIXEL_X + offset), load(state, PIXEL_Y + offset)
        dx, dy = pixel_x - x, pixel_y - y
        left = load(state, LEFT + offset)
        exponent = log2_alpha(*terms, pixel_x, pixel_y)
        raw_alpha = exp2(exponent, limits.exp2)
        uncut = raw_alpha < limits.alpha_max
        alpha = minimum(raw_alpha, filled(limits.alpha_max, raw_alpha))
        alpha = select(exponent >= limits.log2_alpha_min, alpha, zero)
        after = fma(-alpha, left, left)
        goes_on = after > limits.transmittance_min
        store(state, LEFT + offset, select(goes_on, after, zero))
        weight = select(goes_on, alpha * left, zero)
        grad_red, grad_green = load(state, GRAD_RED + offset), load(state, GRAD_GREEN + offset)
        grad_blue = load(state, GRAD_BLUE + offset)
        share = fma(grad_red, red, load(state, GRAD_ALPHA + offset))
        share = fma(grad_blue, blue, fma(grad_green, green, share))
        behind = fma(-weight, share, load(state, BEHIND + offset))
        store(state, BEHIND + offset, behind)
        # d alpha / d sigma = -alpha where the splat is drawn and not cut to alpha_max
        grad_sigma = select(uncut & goes_on, alpha * fma(-left, share, behind / (1 - alpha)), zero)
        sum_red, sum_green = fma(weight, grad_red, sum_red), fma(weight, grad_green, sum_green)
        sum_blue = fma(weight, grad_blue, sum_blue)
        along_x, along_y = grad_sigma * dx, grad_sigma * dy
        sum_1, sum_x, sum_y = sum_1 + grad_sigma, sum_x + along_x, sum_y + along_y
        sum_xx, sum_xy, sum_yy = fma(along_x, dx, sum_xx), fma(along_x, dy, sum_xy), fma(along_y, dy, sum_yy)
        if len(absolutes) > 0:
            _, _, a, b, c, _ = terms
            p, q = fma(a, along_x, b * along_y), c * along_y
            sum_abs_x, sum_abs_y = sum_abs_x - negative(a * p), sum_abs_y - negative(fma(b, p, c * q))
        if bits_of(goes_on) == np.uint64(0):
            done |= np.uint64(1) << block
    moments = (sum_red, sum_green, sum_blue, sum_1, sum_x, sum_y, sum_xx, sum_xy, sum_yy)
    if len(absolutes) > 0:
        per_root = spread(record.dtype.type(1 / ROOT_SCALE**2))
        store(sums, place, sums_of((*moments, sum_abs_x * per_root, sum_abs_y * per_root)))
    else:
        store(sums, place, sums_of(moments))
    return done


@kernel
def _add_up(
    nearest: float,
    past: float,
    first_tile: int,
    past_tile: int,
    records: np.ndarray,
    tiles: TileLists,
    seen: np.ndarray,
    pair_sums: np.ndarray,
    sums: np.ndarray,
) -> None:
    """Add the sums of a splat's tiles, for splats at depths from `nearest` to `past`, which are consecutive in each
    tile. The order of the additions is always the same."""
    flat_pairs, flat = pair_sums.reshape(-1), sums.reshape(-1)
    base = np.uint64(tiles.offsets[first_tile])
    for tile in range(np.uint64(first_tile), np.uint64(past_tile)):
        start = np.uint64(tiles.offsets[tile])
        end = start + np.uint64(seen[tile])
        first = _first_at(nearest, start, end, records, tiles.splat_ids)
        stop = _first_at(past, first, end, records, tiles.splat_ids)
        for pair in range(first, stop):
            prefetch(
                flat, np.uint64(tiles.splat_ids[min(pair + PREFETCH_DISTANCE, stop - np.uint64(1))]) * np.uint64(SUMS)
            )
            place = np.uint64(tiles.splat_ids[pair]) * np.uint64(SUMS)
            store(flat, place, load(flat, place) + load(flat_pairs, (pair - base) * np.uint64(SUMS)))


@kernel
def _first_at(depth: float, start: np.uint64, end: np.uint64, records: np.ndarray, splat_ids: np.ndarray) -> np.uint64:
    """Return the first pair of a tile, from `start` to `end`, whose splat is at `depth` or behind it."""
    while start < end:
        middle = (start + end) >> np.uint64(1)
        if np.float32(records[np.uint64(splat_ids[middle]), DEPTH]) < np.float32(depth):
            start = middle + np.uint64(1)
        else:
            end = middle
    return start

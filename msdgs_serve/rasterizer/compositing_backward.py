"""Gradient of the blending. Runs front to back like the forward pass and repeats its arithmetic, so that it takes the
very decisions (which splat is drawn in which pixel) that the image was made with.

For a pixel with gradient g, the splat's share of the loss is s = color · g_rgb + g_alpha and
d loss / d alpha_i = T_i s_i - (what all splats behind it and the background add) / (1 - alpha_i).
"""

from typing import NamedTuple

import numpy as np

from msdgs_serve.rasterizer.atomic import fetch_add
from msdgs_serve.rasterizer.compositing import (
    BLOCK_SIDE,
    BLOCKS,
    PIXELS,
    TILES_A_TURN,
    PixelLimits,
    grid_of_a_tile,
    log2_alpha,
    pixel_limits,
    touched_blocks,
)
from msdgs_serve.rasterizer.exponential import exp2
from msdgs_serve.rasterizer.jit import kernel
from msdgs_serve.rasterizer.lanes import (
    LANES,
    bits_of,
    filled,
    fma,
    load,
    lowest_bit,
    minimum,
    negative,
    select,
    spread,
    store,
    sums_of,
)
from msdgs_serve.rasterizer.projection import (
    BLUE,
    GREEN,
    LOG2_OPACITY,
    RECORD,
    RED,
    ROOT_A,
    ROOT_B,
    ROOT_C,
    ROOT_SCALE,
    Splats,
    X,
    Y,
)
from msdgs_serve.rasterizer.tiles import TileLists
from msdgs_serve.rasterizer.view import TILE, RasterizerOptions
from msdgs_serve.threads import run_parallel, thread_count

# places in a tile's scratch: what is left of the light (with a minus sign where a pixel is done), the pixel's gradient,
# and what is still behind
LEFT, GRAD_RED, GRAD_GREEN, GRAD_BLUE, GRAD_ALPHA, BEHIND = (np.uint64(PIXELS * place) for place in range(6))
SUMS = LANES
"""Numbers of a pair of splat and tile, nine in use: red, green, blue, then the moments of d loss / d sigma about the
splat: 1, x, y, xx, xy, yy."""


class SplatGradients(NamedTuple):
    """d loss / d splat, zero where a splat is not drawn."""

    means2d: np.ndarray  # [N, 2]
    conics: np.ndarray  # [N, 3] of xx, xy (both off-diagonals together), yy
    opacities: np.ndarray  # [N]
    colors: np.ndarray  # [N, 3]


def composite_backward(
    splats: Splats,
    tiles: TileLists,
    options: RasterizerOptions,
    behind: np.ndarray,
    grad_rgb: np.ndarray,
    grad_alpha: np.ndarray,
) -> SplatGradients:
    """Gradients of the splats.

    Args:
        behind: [H, W] the finished pixel times its gradient: rgb · grad_rgb + alpha grad_alpha, background included.
        grad_rgb: [H, W, 3].
        grad_alpha: [H, W].
    """
    records = splats.records
    count, dtype = len(records), records.dtype
    pair_sums = np.zeros((len(tiles.splat_ids), SUMS), dtype)
    turn = np.zeros(1, np.int64)
    arguments = (turn, records, tiles, pixel_limits(options, dtype), behind, grad_rgb, grad_alpha, pair_sums)
    run_parallel(_tiles_backward, [arguments] * thread_count())
    gradients = SplatGradients(
        np.zeros((count, 2), dtype), np.zeros((count, 3), dtype), np.zeros(count, dtype), np.zeros((count, 3), dtype)
    )
    _gather(tiles.splat_ids, pair_sums, records, gradients)
    return gradients


@kernel
def _tiles_backward(
    turn: np.ndarray,
    records: np.ndarray,
    tiles: TileLists,
    limits: PixelLimits,
    behind: np.ndarray,
    grad_rgb: np.ndarray,
    grad_alpha: np.ndarray,
    pair_sums: np.ndarray,
) -> None:
    count = len(tiles.offsets) - 1
    state = np.empty(6 * PIXELS, records.dtype)
    record = np.empty(RECORD, records.dtype)
    origin = np.zeros(RECORD, records.dtype)
    grid = grid_of_a_tile(records)
    height, width = behind.shape
    flat, flat_sums = records.reshape(-1), pair_sums.reshape(-1)
    while True:
        first = fetch_add(turn, TILES_A_TURN)
        if first >= count:
            return
        for tile in range(first, min(first + TILES_A_TURN, count)):
            x0, y0 = TILE * (tile % tiles.columns), TILE * (tile // tiles.columns)
            origin[0], origin[1] = x0, y0
            state[:] = 0
            state[:PIXELS] = 1
            for row in range(min(TILE, height - y0)):
                for column in range(min(TILE, width - x0)):
                    block = (row // BLOCK_SIDE) * BLOCK_SIDE + column // BLOCK_SIDE
                    pixel = np.uint64(block * LANES + (row % BLOCK_SIDE) * BLOCK_SIDE + column % BLOCK_SIDE)
                    state[GRAD_RED + pixel] = grad_rgb[y0 + row, x0 + column, 0]
                    state[GRAD_GREEN + pixel] = grad_rgb[y0 + row, x0 + column, 1]
                    state[GRAD_BLUE + pixel] = grad_rgb[y0 + row, x0 + column, 2]
                    state[GRAD_ALPHA + pixel] = grad_alpha[y0 + row, x0 + column]
                    state[BEHIND + pixel] = behind[y0 + row, x0 + column]
            alive = np.uint64((1 << BLOCKS) - 1)
            for pair in range(np.uint64(tiles.offsets[tile]), np.uint64(tiles.offsets[tile + 1])):
                store(record, 0, load(flat, np.uint64(tiles.splat_ids[pair]) * np.uint64(RECORD)) - load(origin, 0))
                bits = alive & bits_of(touched_blocks(record, np.uint64(0), grid, limits.log2_alpha_min))
                if bits != np.uint64(0):
                    alive &= ~_splat_backward(bits, record, grid, limits, state, flat_sums, pair * np.uint64(SUMS))
                    if alive == np.uint64(0):
                        break


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
    sum_red, sum_green, sum_blue, sum_1, sum_x, sum_y, sum_xx, sum_xy, sum_yy = (
        zero,
        zero,
        zero,
        zero,
        zero,
        zero,
        zero,
        zero,
        zero,
    )
    done = np.uint64(0)
    while bits != np.uint64(0):
        block = lowest_bit(bits)
        bits &= bits - np.uint64(1)
        lane = block * np.uint64(LANES)
        pixel_x, pixel_y = load(grid, 32) + grid[block], load(grid, 48) + grid[np.uint64(16) + block]
        dx, dy = pixel_x - record[X], pixel_y - record[Y]
        left = load(state, LEFT + lane)
        exponent = log2_alpha(record, np.uint64(0), pixel_x, pixel_y)
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
    store(
        sums,
        place,
        sums_of(
            (
                sum_red,
                sum_green,
                sum_blue,
                sum_1,
                sum_x,
                sum_y,
                sum_xx,
                sum_xy,
                sum_yy,
                zero,
                zero,
                zero,
                zero,
                zero,
                zero,
                zero,
            )
        ),
    )
    return done


@kernel
def _gather(splat_ids: np.ndarray, pair_sums: np.ndarray, records: np.ndarray, gradients: SplatGradients) -> None:
    """Add up each splat's tiles, always in the same order, and turn moments into gradients."""
    real = records.dtype.type
    unscaled = real(1 / ROOT_SCALE)
    for pair in range(len(splat_ids)):
        i = splat_ids[pair]
        sums = pair_sums[pair]
        a, b, c = records[i, ROOT_A] * unscaled, records[i, ROOT_B] * unscaled, records[i, ROOT_C] * unscaled
        for channel in range(3):
            gradients.colors[i, channel] += sums[channel]
        # sigma = half of xx dx² + 2 xy dx dy + yy dy², with dx and dy growing as the mean falls
        gradients.means2d[i, 0] -= a * a * sums[4] + a * b * sums[5]
        gradients.means2d[i, 1] -= a * b * sums[4] + (b * b + c * c) * sums[5]
        gradients.conics[i, 0] += sums[6] / 2
        gradients.conics[i, 1] += sums[7]
        gradients.conics[i, 2] += sums[8] / 2
        gradients.opacities[i] -= sums[3] / 2 ** records[i, LOG2_OPACITY]

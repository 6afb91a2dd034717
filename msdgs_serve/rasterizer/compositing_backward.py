"""Gradient of the blending. Runs front to back like the forward pass and repeats its arithmetic, so that it takes the
very decisions (which splat is drawn in which pixel) that the image was made with.

For a pixel with gradient g, the splat's share of the loss is s = color · g_rgb + g_alpha and
d loss / d alpha_i = T_i s_i - (what all splats behind it and the background add) / (1 - alpha_i).
"""

from typing import NamedTuple

import numpy as np

from msdgs_serve.rasterizer.compositing import (
    DRAWING,
    LANES,
    PIXELS,
    SPLATS_BETWEEN_CHECKS,
    TRANSMITTANCE,
    PixelLimits,
    balanced_chunks,
    is_drawing,
    pixel_limits,
    row_range,
)
from msdgs_serve.rasterizer.exponential import exp_nonpositive
from msdgs_serve.rasterizer.jit import kernel
from msdgs_serve.rasterizer.projection import Splats
from msdgs_serve.rasterizer.tiles import TILE, TileLists
from msdgs_serve.rasterizer.view import RasterizerOptions
from msdgs_serve.threads import run_parallel

# places in a tile's scratch after TRANSMITTANCE and DRAWING: the pixel's gradient, and what is still behind
GRAD_RED, GRAD_GREEN, GRAD_BLUE, GRAD_ALPHA, BEHIND = (np.uint64(PIXELS * place) for place in range(2, 7))
# nine sums of a splat, a row of lanes each, in an array of their own: red, green, blue, then the moments of
# d loss / d sigma about the splat
SUMS = 9
(SUM_RED, SUM_GREEN, SUM_BLUE, SUM_1, SUM_X, SUM_Y, SUM_XX, SUM_XY, SUM_YY) = (
    np.uint64(TILE * place) for place in range(SUMS)
)


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
    dtype = splats.means2d.dtype
    pair_sums = np.zeros((len(tiles.splat_ids), SUMS), dtype)
    limits = pixel_limits(options, dtype)
    run_parallel(
        _tiles_backward,
        [(*chunk, splats, tiles, limits, behind, grad_rgb, grad_alpha, pair_sums) for chunk in balanced_chunks(tiles)],
    )
    count = len(splats.depths)
    gradients = SplatGradients(
        np.zeros((count, 2), dtype), np.zeros((count, 3), dtype), np.zeros(count, dtype), np.zeros((count, 3), dtype)
    )
    _gather(tiles.splat_ids, pair_sums, splats, gradients)
    return gradients


@kernel
def _tiles_backward(
    start: int,
    stop: int,
    splats: Splats,
    tiles: TileLists,
    limits: PixelLimits,
    behind: np.ndarray,
    grad_rgb: np.ndarray,
    grad_alpha: np.ndarray,
    pair_sums: np.ndarray,
) -> None:
    scratch = np.empty(7 * PIXELS, splats.means2d.dtype)
    sums = np.empty(SUMS * TILE, splats.means2d.dtype)
    height, width = behind.shape
    for tile in range(start, stop):
        x0, y0 = TILE * (tile % tiles.columns), TILE * (tile // tiles.columns)
        rows, columns = min(TILE, height - y0), min(TILE, width - x0)
        scratch[:] = 0
        for row in range(rows):
            for column in range(columns):
                pixel = np.uint64(row * TILE + column)
                scratch[TRANSMITTANCE + pixel] = 1
                scratch[DRAWING + pixel] = 1
                scratch[GRAD_RED + pixel] = grad_rgb[y0 + row, x0 + column, 0]
                scratch[GRAD_GREEN + pixel] = grad_rgb[y0 + row, x0 + column, 1]
                scratch[GRAD_BLUE + pixel] = grad_rgb[y0 + row, x0 + column, 2]
                scratch[GRAD_ALPHA + pixel] = grad_alpha[y0 + row, x0 + column]
                scratch[BEHIND + pixel] = behind[y0 + row, x0 + column]
        since_check = 0
        for pair in range(tiles.offsets[tile], tiles.offsets[tile + 1]):
            _splat_backward(np.uint64(tiles.splat_ids[pair]), splats, x0, y0, rows, limits, scratch, sums)
            for place in range(SUMS):
                total = sums[place * TILE]
                for lane in range(1, TILE):
                    total += sums[place * TILE + lane]
                pair_sums[pair, place] = total
            since_check += 1
            if since_check == SPLATS_BETWEEN_CHECKS:
                since_check = 0
                if not is_drawing(scratch):
                    break


@kernel
def _splat_backward(
    i: np.uint64,
    splats: Splats,
    x0: int,
    y0: int,
    rows: int,
    limits: PixelLimits,
    scratch: np.ndarray,
    sums: np.ndarray,
) -> None:
    real = scratch.dtype.type
    zero, one, half = real(0), real(1), real(0.5)
    a, b, c = splats.conic_roots[i, 0], splats.conic_roots[i, 1], splats.conic_roots[i, 2]
    red, green, blue = splats.colors[i, 0], splats.colors[i, 1], splats.colors[i, 2]
    opacity = splats.opacities[i]
    x = real(splats.means2d[i, 0] - x0) - half
    y = real(splats.means2d[i, 1] - y0) - half
    first, past = row_range(splats.means2d[i, 1], splats.extents[i, 1], y0, rows)
    sums[:] = 0
    for row in range(first, past):
        dy = real(row) - y
        b_dy, c_dy = b * dy, c * dy
        cc = c_dy * c_dy
        base = np.uint64(row) * LANES
        for lane in range(LANES):
            pixel = base + lane
            dx = real(lane) - x
            root = a * dx + b_dy
            raw_alpha = opacity * exp_nonpositive(-half * (root * root + cc))
            alpha = raw_alpha if raw_alpha < limits.alpha_max else limits.alpha_max
            transmittance = scratch[TRANSMITTANCE + pixel]
            drawing = scratch[DRAWING + pixel]
            alpha = drawing * (alpha if alpha >= limits.alpha_min else zero)
            left = transmittance * (one - alpha)
            stops = left <= limits.transmittance_min
            alpha = zero if stops else alpha
            weight = alpha * transmittance
            scratch[DRAWING + pixel] = zero if stops else drawing
            scratch[TRANSMITTANCE + pixel] = transmittance if stops else left

            grad_red, grad_green, grad_blue = (
                scratch[GRAD_RED + pixel],
                scratch[GRAD_GREEN + pixel],
                scratch[GRAD_BLUE + pixel],
            )
            share = red * grad_red + green * grad_green + blue * grad_blue + scratch[GRAD_ALPHA + pixel]
            behind = scratch[BEHIND + pixel] - weight * share
            scratch[BEHIND + pixel] = behind
            grad_alpha = transmittance * share - behind / (one - alpha)
            # d alpha / d sigma = -alpha where the splat is drawn and not cut to alpha_max
            grad_sigma = -alpha * (grad_alpha if raw_alpha < limits.alpha_max else zero)
            sums[SUM_RED + lane] += weight * grad_red
            sums[SUM_GREEN + lane] += weight * grad_green
            sums[SUM_BLUE + lane] += weight * grad_blue
            sums[SUM_1 + lane] += grad_sigma
            sums[SUM_X + lane] += grad_sigma * dx
            sums[SUM_Y + lane] += grad_sigma * dy
            sums[SUM_XX + lane] += grad_sigma * dx * dx
            sums[SUM_XY + lane] += grad_sigma * dx * dy
            sums[SUM_YY + lane] += grad_sigma * dy * dy


@kernel
def _gather(splat_ids: np.ndarray, pair_sums: np.ndarray, splats: Splats, gradients: SplatGradients) -> None:
    """Add up each splat's tiles, always in the same order, and turn moments into gradients."""
    for pair in range(len(splat_ids)):
        i = splat_ids[pair]
        sums = pair_sums[pair]
        a, b, c = splats.conic_roots[i, 0], splats.conic_roots[i, 1], splats.conic_roots[i, 2]
        for channel in range(3):
            gradients.colors[i, channel] += sums[channel]
        # sigma = half of xx dx² + 2 xy dx dy + yy dy², with dx and dy growing as the mean falls
        gradients.means2d[i, 0] -= a * a * sums[4] + a * b * sums[5]
        gradients.means2d[i, 1] -= a * b * sums[4] + (b * b + c * c) * sums[5]
        gradients.conics[i, 0] += sums[6] / 2
        gradients.conics[i, 1] += sums[7]
        gradients.conics[i, 2] += sums[8] / 2
        gradients.opacities[i] -= sums[3] / splats.opacities[i]

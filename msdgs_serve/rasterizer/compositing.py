"""Alpha blending of the splats of each tile, front to back (equation 2).

A tile's pixels are blended together, a row of 16 at a time: each line of the inner loop is one vector operation.
All state of a tile lives in one scratch array at fixed places: LLVM then sees that its parts do not overlap.
"""

import itertools
from typing import NamedTuple

import numpy as np

from msdgs_serve.rasterizer.exponential import exp_nonpositive
from msdgs_serve.rasterizer.jit import kernel
from msdgs_serve.rasterizer.projection import Splats
from msdgs_serve.rasterizer.tiles import TILE, TileLists
from msdgs_serve.rasterizer.view import RasterizerOptions
from msdgs_serve.threads import run_parallel, thread_count

PIXELS = TILE * TILE
# unsigned, or numba compiles a test for negative indices into every access: 3.5x
LANES = np.uint64(TILE)
TRANSMITTANCE, DRAWING, RED, GREEN, BLUE, DEPTH = (np.uint64(PIXELS * place) for place in range(6))
SPLATS_BETWEEN_CHECKS = 16


class Blend(NamedTuple):
    """The blended image, before division by alpha and before the background."""

    rgb: np.ndarray  # [H, W, 3] sum of c alpha T
    transmittance: np.ndarray  # [H, W] what of the background is seen
    depth: np.ndarray  # [H, W] sum of z alpha T


def composite(splats: Splats, tiles: TileLists, width: int, height: int, options: RasterizerOptions) -> Blend:
    """Blend the splats into an image of the splats' dtype."""
    dtype = splats.means2d.dtype
    rgb, transmittance, depth = (np.empty((height, width, *more), dtype) for more in ((3,), (), ()))
    blend = Blend(rgb, transmittance, depth)
    limits = pixel_limits(options, dtype)
    run_parallel(_composite_tiles, [(*chunk, splats, tiles, limits, blend) for chunk in balanced_chunks(tiles)])
    return blend


class PixelLimits(NamedTuple):
    """The options that the inner loop needs, in its dtype."""

    alpha_min: np.floating
    alpha_max: np.floating
    transmittance_min: np.floating


def pixel_limits(options: RasterizerOptions, dtype: np.dtype) -> PixelLimits:
    """`options` as scalars of `dtype`, so that no float64 enters a float32 loop."""
    real = dtype.type
    return PixelLimits(real(options.alpha_min), real(options.alpha_max), real(options.transmittance_min))


def balanced_chunks(tiles: TileLists) -> list[tuple[int, int]]:
    """Ranges of tiles of about equal numbers of pairs, four a thread."""
    parts = 4 * thread_count()
    work = tiles.offsets + 64 * np.arange(len(tiles.offsets))  # an empty tile costs something too
    edges = np.searchsorted(work, work[-1] * np.arange(1, parts) / parts)
    edges = np.unique(np.concatenate([[0], edges, [len(tiles.offsets) - 1]]))
    return [(int(start), int(stop)) for start, stop in itertools.pairwise(edges)]


@kernel
def _composite_tiles(
    start: int, stop: int, splats: Splats, tiles: TileLists, limits: PixelLimits, blend: Blend
) -> None:
    scratch = np.empty(6 * PIXELS, splats.means2d.dtype)
    height, width = blend.transmittance.shape
    for tile in range(start, stop):
        x0, y0 = TILE * (tile % tiles.columns), TILE * (tile // tiles.columns)
        rows, columns = min(TILE, height - y0), min(TILE, width - x0)
        scratch[:] = 0
        scratch[: 2 * PIXELS] = 1
        since_check = 0
        for pair in range(tiles.offsets[tile], tiles.offsets[tile + 1]):
            _blend_splat(np.uint64(tiles.splat_ids[pair]), splats, x0, y0, rows, limits, scratch)
            since_check += 1
            if since_check == SPLATS_BETWEEN_CHECKS:
                since_check = 0
                if not is_drawing(scratch):
                    break
        for row in range(rows):
            for column in range(columns):
                pixel = np.uint64(row * TILE + column)
                blend.rgb[y0 + row, x0 + column, 0] = scratch[RED + pixel]
                blend.rgb[y0 + row, x0 + column, 1] = scratch[GREEN + pixel]
                blend.rgb[y0 + row, x0 + column, 2] = scratch[BLUE + pixel]
                blend.transmittance[y0 + row, x0 + column] = scratch[TRANSMITTANCE + pixel]
                blend.depth[y0 + row, x0 + column] = scratch[DEPTH + pixel]


@kernel
def is_drawing(scratch: np.ndarray) -> bool:
    """Whether any pixel of the tile is still open."""
    for pixel in range(DRAWING, DRAWING + np.uint64(PIXELS)):
        if scratch[pixel] > 0:
            return True
    return False


@kernel
def row_range(y: float, extent: float, y0: int, rows: int) -> tuple[int, int]:
    """The rows of a tile whose pixel centres lie within `extent` of `y`, as (first, past the last)."""
    first = max(0.0, np.ceil(y - extent - 0.5 - y0))
    past = min(float(rows), np.floor(y + extent - 0.5 - y0) + 1.0)
    return int(min(first, float(rows))), int(max(past, 0.0))


@kernel
def _blend_splat(
    i: np.uint64, splats: Splats, x0: int, y0: int, rows: int, limits: PixelLimits, scratch: np.ndarray
) -> None:
    real = scratch.dtype.type
    one, half = real(1), real(0.5)
    a, b, c = splats.conic_roots[i, 0], splats.conic_roots[i, 1], splats.conic_roots[i, 2]
    red, green, blue = splats.colors[i, 0], splats.colors[i, 1], splats.colors[i, 2]
    opacity, depth = splats.opacities[i], splats.depths[i]
    # tile-relative, so that the loop counts pixels from 0
    x = real(splats.means2d[i, 0] - x0) - half
    y = real(splats.means2d[i, 1] - y0) - half
    first, past = row_range(splats.means2d[i, 1], splats.extents[i, 1], y0, rows)
    for row in range(first, past):
        dy = real(row) - y
        b_dy, c_dy = b * dy, c * dy
        cc = c_dy * c_dy
        base = np.uint64(row) * LANES
        for lane in range(LANES):
            pixel = base + lane
            root = a * (real(lane) - x) + b_dy
            alpha = opacity * exp_nonpositive(-half * (root * root + cc))
            alpha = alpha if alpha < limits.alpha_max else limits.alpha_max
            transmittance = scratch[TRANSMITTANCE + pixel]
            drawing = scratch[DRAWING + pixel]
            alpha = drawing * (alpha if alpha >= limits.alpha_min else real(0))
            left = transmittance * (one - alpha)
            stops = left <= limits.transmittance_min
            alpha = real(0) if stops else alpha
            weight = alpha * transmittance
            scratch[DRAWING + pixel] = real(0) if stops else drawing
            scratch[TRANSMITTANCE + pixel] = transmittance if stops else left
            scratch[RED + pixel] += weight * red
            scratch[GREEN + pixel] += weight * green
            scratch[BLUE + pixel] += weight * blue
            scratch[DEPTH + pixel] += weight * depth

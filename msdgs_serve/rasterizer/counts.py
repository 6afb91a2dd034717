"""Count the splats that each pixel blends, an image of where a frame's work is. A pass of its own after drawing."""

from typing import NamedTuple

import numpy as np

from msdgs_serve.rasterizer.alpha import PixelLimits, exponent_terms, log2_alpha, pixel_limits
from msdgs_serve.rasterizer.jit import kernel
from msdgs_serve.rasterizer.simd.exponential import exp2
from msdgs_serve.rasterizer.simd.memory import load, store
from msdgs_serve.rasterizer.simd.types import NUM_LANES
from msdgs_serve.rasterizer.simd.vectors import bits_of, filled, first_of, fma, minimum, negative, pair, select, spread
from msdgs_serve.rasterizer.splats import RECORD, Splats
from msdgs_serve.rasterizer.tile_blocks import BLOCKS, PIXELS, grid_of_a_tile, place_in_tile, touched_blocks
from msdgs_serve.rasterizer.tiles import TileLists
from msdgs_serve.rasterizer.view import TILE, RasterizerOptions
from msdgs_serve.threads import run_parallel, split_evenly, threads_to_use


class Counts(NamedTuple):
    """Numbers of splats in one frame."""

    blended: np.ndarray  # [H, W] splats that contribute to a pixel, in the splats' dtype
    evaluated: int  # pairs of splat and pixel whose alpha is computed: pixels of touched, unfinished 4 × 4 blocks


def count_splats(splats: Splats, tiles: TileLists, width: int, height: int, options: RasterizerOptions) -> Counts:
    """Repeat the decisions of `composite`, and count instead of blending."""
    limits = pixel_limits(options, splats.records.dtype)
    blended = np.empty((height, width), splats.records.dtype)
    ranges = split_evenly(len(tiles.offsets) - 1, 8 * threads_to_use())
    evaluated = run_parallel(
        _count_tiles, [(*part, splats.records, splats.origin, tiles, limits, blended) for part in ranges]
    )
    return Counts(blended, sum(evaluated))


@kernel
def _count_tiles(
    start: int,
    stop: int,
    records: np.ndarray,
    first: tuple[int, int],
    tiles: TileLists,
    limits: PixelLimits,
    blended: np.ndarray,
) -> int:
    grid = grid_of_a_tile(records)
    record, origin = np.zeros(RECORD, records.dtype), np.zeros(RECORD, records.dtype)
    state, added = np.empty(PIXELS, records.dtype), np.empty(PIXELS, records.dtype)
    flat = records.reshape(-1)
    height, width = blended.shape
    evaluated = 0
    for tile in range(start, stop):
        x0, y0 = TILE * (tile % tiles.columns), TILE * (tile // tiles.columns)
        origin[0], origin[1] = first[0] + x0, first[1] + y0
        state[:] = 1
        added[:] = 0
        for entry in range(tiles.offsets[tile], tiles.offsets[tile + 1]):
            store(record, 0, load(flat, np.uint64(tiles.splat_ids[entry]) * np.uint64(RECORD)) - load(origin, 0))
            touched = bits_of(touched_blocks(record, grid, limits.log2_alpha_min))
            terms = exponent_terms(record)
            for block in range(BLOCKS):
                left = load(state, NUM_LANES * block)
                if touched >> np.uint64(block) & np.uint64(1) == np.uint64(0) or bits_of(left > 0) == np.uint64(0):
                    continue
                x, y = load(grid, 32) + grid[block], load(grid, 48) + grid[16 + block]
                exponent = log2_alpha(*terms, x, y)
                # two vectors as in `composite`, so that LLVM generates the same instructions
                alpha = first_of(exp2(pair(exponent, exponent), limits.exp2))
                alpha = minimum(alpha, spread(limits.alpha_max))
                drawn = (exponent >= limits.log2_alpha_min) & (left > 0)
                after = fma(-alpha, left, left)
                goes_on = drawn & (after > limits.transmittance_min)
                store(state, NUM_LANES * block, select(goes_on, after, select(drawn, negative(left), left)))
                count = load(added, NUM_LANES * block)
                store(added, NUM_LANES * block, count + select(goes_on, filled(1, count), filled(0, count)))
                evaluated += NUM_LANES
        for row in range(min(TILE, height - y0)):
            for column in range(min(TILE, width - x0)):
                blended[y0 + row, x0 + column] = added[place_in_tile(row, column)]
    return evaluated

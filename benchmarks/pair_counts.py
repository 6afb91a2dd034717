"""How much work a frame is: every splat in every pixel of its tiles, counted exactly, apart from what is timed."""

from typing import NamedTuple

import numpy as np

from msdgs_serve.rasterizer.compositing import PixelLimits, grid_of_a_tile, log2_alpha, pixel_limits, touched_blocks
from msdgs_serve.rasterizer.exponential import exp2
from msdgs_serve.rasterizer.jit import kernel
from msdgs_serve.rasterizer.lanes import (
    LANES,
    bits_of,
    first_of,
    fma,
    load,
    minimum,
    negative,
    pair,
    select,
    spread,
    store,
)
from msdgs_serve.rasterizer.projection import RECORD, Splats
from msdgs_serve.rasterizer.tiles import TileLists
from msdgs_serve.rasterizer.view import TILE, RasterizerOptions
from msdgs_serve.threads import run_parallel, split_evenly, thread_count

BLOCKS = TILE * TILE // LANES


class PairCounts(NamedTuple):
    """Of one frame."""

    visible: int  # splats
    tile_entries: int  # a splat in a tile
    lanes: int  # a splat in a pixel of a 4 × 4 block that its ellipse touches and that is not done: the arithmetic
    blended: int  # a splat in a pixel to which it adds


def count_pairs(splats: Splats, tiles: TileLists, width: int, height: int, options: RasterizerOptions) -> PairCounts:
    """Take the decisions of the compositing, and count instead of blending."""
    limits = pixel_limits(options, splats.records.dtype)
    tile_count = len(tiles.offsets) - 1
    ranges = split_evenly(tile_count, 8 * thread_count())
    found = run_parallel(_count_tiles, [(*part, splats.records, tiles, limits, width, height) for part in ranges])
    lanes, blended = (sum(part[k] for part in found) for k in range(2))
    return PairCounts(len(splats.visible), len(tiles.splat_ids), lanes, blended)


@kernel
def _count_tiles(
    start: int, stop: int, records: np.ndarray, tiles: TileLists, limits: PixelLimits, width: int, height: int
) -> tuple[int, int]:
    real = records.dtype.type
    grid = grid_of_a_tile(records)
    record, origin = np.zeros(RECORD, records.dtype), np.zeros(RECORD, records.dtype)
    state = np.empty(TILE * TILE, records.dtype)
    flat = records.reshape(-1)
    lanes, blended = 0, 0
    for tile in range(start, stop):
        x0, y0 = TILE * (tile % tiles.columns), TILE * (tile // tiles.columns)
        origin[0], origin[1] = x0, y0
        state[:] = 1
        for entry in range(tiles.offsets[tile], tiles.offsets[tile + 1]):
            store(record, 0, load(flat, np.uint64(tiles.splat_ids[entry]) * np.uint64(RECORD)) - load(origin, 0))
            touched = bits_of(touched_blocks(record, np.uint64(0), grid, limits.log2_alpha_min))
            for block in range(BLOCKS):
                left = load(state, LANES * block)
                if touched >> np.uint64(block) & np.uint64(1) == np.uint64(0) or bits_of(left > 0) == np.uint64(0):
                    continue
                x, y = load(grid, 32) + grid[block], load(grid, 48) + grid[16 + block]
                exponent = log2_alpha(record, np.uint64(0), x, y)
                # 32 lanes as the compositing has them, so that LLVM makes the same instructions
                alpha = first_of(exp2(pair(exponent, exponent), limits.exp2))
                alpha = minimum(alpha, spread(limits.alpha_max))
                drawn = (exponent >= limits.log2_alpha_min) & (left > 0)
                after = fma(-alpha, left, left)
                goes_on = drawn & (after > limits.transmittance_min)
                store(state, LANES * block, select(goes_on, after, select(drawn, negative(left), left)))
                inside = (x0 + x < real(width)) & (y0 + y < real(height))
                lanes += LANES
                blended += _ones(bits_of(goes_on & inside))
    return lanes, blended


@kernel
def _ones(bits: np.uint64) -> int:
    count = 0
    while bits != np.uint64(0):
        bits &= bits - np.uint64(1)
        count += 1
    return count

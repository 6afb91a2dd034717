"""How much work a frame is: every splat in every pixel of its tiles, counted exactly, apart from what is timed."""

from typing import NamedTuple

from msdgs_serve.rasterizer.counts import count_splats
from msdgs_serve.rasterizer.projection import Splats
from msdgs_serve.rasterizer.tiles import TileLists
from msdgs_serve.rasterizer.view import RasterizerOptions


class PairCounts(NamedTuple):
    """Of one frame."""

    visible: int  # splats
    tile_entries: int  # a splat in a tile
    lanes: int  # a splat in a pixel of a 4 × 4 block that its ellipse touches and that is not done: the arithmetic
    blended: int  # a splat in a pixel to which it adds


def count_pairs(splats: Splats, tiles: TileLists, width: int, height: int, options: RasterizerOptions) -> PairCounts:
    """Take the decisions of the compositing, and count instead of blending."""
    counts = count_splats(splats, tiles, width, height, options)
    return PairCounts(splats.visible, len(tiles.splat_ids), counts.lanes, int(counts.blended.sum(dtype=float)))

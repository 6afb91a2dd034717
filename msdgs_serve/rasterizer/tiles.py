"""Which splats touch which tile of the image, nearest first."""

import math
from typing import NamedTuple

import numpy as np

from msdgs_serve.rasterizer.jit import kernel
from msdgs_serve.rasterizer.projection import Splats

TILE = 16
"""Pixels along a tile's side."""


class TileLists(NamedTuple):
    """The splats of tile k are `splat_ids[offsets[k]:offsets[k + 1]]`, front to back. Tiles run row by row."""

    offsets: np.ndarray  # [tiles + 1] int64
    splat_ids: np.ndarray  # [pairs] int32
    columns: int
    rows: int


def bin_into_tiles(splats: Splats, width: int, height: int) -> TileLists:
    """Sort the visible splats once by float32 depth, equal depths by index, then deal them out to the tiles."""
    columns, rows = -(-width // TILE), -(-height // TILE)
    visible = np.flatnonzero(splats.extents[:, 0] > 0)
    # the bits of a positive float32 sort as the float does; with the index below them no two keys are equal, and
    # sorting one array of integers is 4x faster than a stable argsort
    depth_bits = splats.depths[visible].astype(np.float32).view(np.uint32).astype(np.uint64)
    keys = np.sort((depth_bits << np.uint64(32)) | visible.astype(np.uint64))
    order = (keys & np.uint64(0xFFFFFFFF)).astype(np.int32)
    rectangles = np.empty((len(order), 4), np.int32)
    offsets = np.zeros(columns * rows + 1, np.int64)
    _count_pairs(order, splats.means2d, splats.extents, columns, rows, rectangles, offsets)
    np.cumsum(offsets, out=offsets)
    splat_ids = np.empty(offsets[-1], np.int32)
    _deal_out(order, rectangles, offsets[:-1].copy(), columns, splat_ids)
    return TileLists(offsets, splat_ids, columns, rows)


@kernel
def _count_pairs(
    order: np.ndarray,
    means2d: np.ndarray,
    extents: np.ndarray,
    columns: int,
    rows: int,
    rectangles: np.ndarray,
    offsets: np.ndarray,
) -> None:
    for k in range(len(order)):
        i = order[k]
        x, y, ex, ey = float(means2d[i, 0]), float(means2d[i, 1]), float(extents[i, 0]), float(extents[i, 1])
        # clamped as floats: a giant's bounds do not fit an integer
        rectangles[k, 0] = int(max(0.0, math.floor((x - ex) / TILE)))
        rectangles[k, 1] = int(min(float(columns), math.floor((x + ex) / TILE) + 1))
        rectangles[k, 2] = int(max(0.0, math.floor((y - ey) / TILE)))
        rectangles[k, 3] = int(min(float(rows), math.floor((y + ey) / TILE) + 1))
        for row in range(rectangles[k, 2], rectangles[k, 3]):
            for column in range(rectangles[k, 0], rectangles[k, 1]):
                offsets[row * columns + column + 1] += 1


@kernel
def _deal_out(
    order: np.ndarray, rectangles: np.ndarray, cursors: np.ndarray, columns: int, splat_ids: np.ndarray
) -> None:
    for k in range(len(order)):
        for row in range(rectangles[k, 2], rectangles[k, 3]):
            for column in range(rectangles[k, 0], rectangles[k, 1]):
                tile = row * columns + column
                splat_ids[cursors[tile]] = order[k]
                cursors[tile] += 1

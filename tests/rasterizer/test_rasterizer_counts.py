"""How many splats each pixel blends, against splats taken one by one."""

import numpy as np
import pytest

from msdgs_serve.rasterizer import GSPLAT, rasterize
from msdgs_serve.rasterizer.counts import count_splats
from msdgs_serve.rasterizer.projection import project
from msdgs_serve.rasterizer.splats import LOG2_OPACITY, ROOT_A, ROOT_B, ROOT_C, X, Y
from msdgs_serve.rasterizer.tiles import bin_into_tiles
from tests.support.scenes import as_dtype, random_scene


def blended_one_by_one(records: np.ndarray, order: np.ndarray, width: int, height: int) -> np.ndarray:
    """[H, W] splats that add to each pixel, splat by splat over the whole image."""
    y, x = np.mgrid[:height, :width] + 0.5
    left, stopped, counts = np.ones_like(x), np.zeros(x.shape, bool), np.zeros_like(x)
    for record in records[order]:
        dx, dy = x - record[X], y - record[Y]
        p, q = record[ROOT_A] * dx + record[ROOT_B] * dy, record[ROOT_C] * dy
        raw_alpha = np.exp2(record[LOG2_OPACITY] - p * p - q * q)
        drawn = (raw_alpha >= GSPLAT.alpha_min) & ~stopped
        after = left * (1 - np.minimum(raw_alpha, GSPLAT.alpha_max))
        stopped |= drawn & (after <= GSPLAT.transmittance_min)
        blended = drawn & ~stopped
        left = np.where(blended, after, left)
        counts += blended
    return counts


@pytest.mark.parametrize(("count", "width", "height"), [(0, 20, 20), (40, 21, 20), (400, 53, 37), (2000, 64, 48)])
def test_pairs_are_counted_exactly(count: int, width: int, height: int):
    gaussians, camera = random_scene(90, count, width, height)
    splats = project(as_dtype(gaussians, np.float64), camera, GSPLAT)
    tiles = bin_into_tiles(splats, width, height)
    counts = count_splats(splats, tiles, width, height, GSPLAT)
    image = rasterize(as_dtype(gaussians, np.float64), camera, counts=True)
    keys = np.concatenate([splats.keys[start:stop] for start, stop in splats.drawn])
    order = (np.sort(keys) & np.uint64(0xFFFFFFFF)).astype(int)
    np.testing.assert_array_equal(image.counts, blended_one_by_one(splats.records, order, width, height))
    np.testing.assert_array_equal(counts.blended, image.counts)
    assert splats.visible == len(order)
    assert counts.blended.sum() <= counts.evaluated <= 256 * len(tiles.splat_ids)

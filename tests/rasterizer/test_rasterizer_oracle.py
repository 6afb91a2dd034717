"""The kernels against the float64 loop renderer, on random and on adversarial scenes, and blended splats counted."""

from dataclasses import replace

import numpy as np
import pytest

from msdgs_serve.rasterizer import GSPLAT, RasterizerOptions, Rendering, rasterize
from msdgs_serve.rasterizer.counts import count_splats
from msdgs_serve.rasterizer.projection import project
from msdgs_serve.rasterizer.splats import LOG2_OPACITY, ROOT_A, ROOT_B, ROOT_C, X, Y
from msdgs_serve.rasterizer.tiles import bin_into_tiles
from tests.support.reference import DEPTH_BAND, Reference, render
from tests.support.scenes import ADVERSARIAL, OPTIONS, as_dtype, draw, front_camera, gaussians_of, random_scene
from tests.support.tolerances import tolerance

MANY = "ten_thousand_on_a_pixel"
NAMES = [*sorted(ADVERSARIAL.keys() - {MANY}), pytest.param(MANY, marks=pytest.mark.slow)]

BACKGROUND = (0.2, 0.6, 0.9)
EXACT_DEPTHS = {"equal_depths"}


def assert_same_image(got: Rendering, want: Reference, row: str, min_clean: float = 0.5):
    """Compare tightly except at thresholds, where the effect of the decision is allowed as well."""
    clean = want.slack == 0
    assert clean.mean() >= min_clean, "the comparison would be empty"
    for name in ("rgb", "alpha"):
        channel, expected = getattr(got, name), getattr(want, name)
        assert np.isfinite(channel).all(), name
        scale = want.color_range if name == "rgb" else 1.0
        error = np.abs(channel - expected).reshape(*clean.shape, -1).max(axis=-1)
        assert error[clean].max(initial=0) <= tolerance(f"{name}.{row}"), f"{name}, pixels away from thresholds"
        excess = error - want.slack * max(scale, 1.0)
        assert excess.max(initial=0) <= tolerance(f"{name}.{row}"), f"{name}, pixels at a threshold"
    assert_same_depth(got, want, row)
    mse = np.mean((got.rgb - want.rgb) ** 2)
    assert mse == 0 or 10 * np.log10(1 / mse) >= tolerance("oracle_db")


def assert_same_depth(got: Rendering, want: Reference, row: str):
    clean = want.slack == 0
    empty = np.isinf(want.depth)
    np.testing.assert_array_equal(np.isinf(got.depth)[clean], empty[clean])
    seen = clean & ~empty
    relative = np.abs(got.depth[seen] / want.depth[seen] - 1)
    assert relative.max(initial=0) <= tolerance(f"depth.{row}.relative")


@pytest.mark.parametrize(
    ("seed", "count", "width", "height", "degree"),
    [
        (0, 300, 53, 37, 3),
        (1, 300, 64, 48, 2),
        (2, 600, 17, 71, 1),
        (3, 50, 16, 16, 0),
        (4, 300, 1, 1, 3),
        (5, 300, 33, 1, 3),
        (6, 1, 53, 37, 3),
        (7, 0, 53, 37, 3),
        (12, 15, 53, 37, 3),
        (13, 17, 37, 53, 2),
        (14, 47, 16, 17, 1),
    ],
)
def test_random_scenes(seed: int, count: int, width: int, height: int, degree: int):
    gaussians, camera = random_scene(seed, count, width, height, sh_degree=degree)
    got = draw(gaussians, camera, background=BACKGROUND)
    assert got.rgb.dtype == got.alpha.dtype == got.depth.dtype == np.float32
    assert got.rgb.shape == (height, width, 3)
    assert got.alpha.shape == got.depth.shape == (height, width)
    assert_same_image(got, render(gaussians, camera, BACKGROUND), "float32")


@pytest.mark.parametrize("name", NAMES)
def test_adversarial_scenes(name: str):
    gaussians, camera = ADVERSARIAL[name]()
    want = render(gaussians, camera, BACKGROUND, depth_band=0.0 if name in EXACT_DEPTHS else DEPTH_BAND)
    assert_same_image(draw(gaussians, camera, background=BACKGROUND), want, "float32")


@pytest.mark.slow
def test_largest_image():
    """A few splats, small, large and at the far corner, are correct in 8192 × 8192 pixels."""
    side = 8192
    camera = front_camera(side, side, focal=6000.0)
    means = np.array([[0, 0, 3], [-1.2, 1.3, 2], [0.5, -1.0, 2.2], [1.36, 1.36, 2]])
    gaussians = gaussians_of(means, scales=[0.3, 0.002, 1e-5, 0.01], opacities=0.8)
    got = draw(gaussians, camera, background=BACKGROUND)
    assert got.rgb.shape == (side, side, 3)
    centers = means[:, :2] / means[:, 2:] * 6000 + side / 2
    for x, y in np.clip(centers.astype(int) - 30, 0, side - 60):
        part = np.s_[y : y + 60, x : x + 60]
        crop = replace(camera, cx=camera.cx - x, cy=camera.cy - y, width=60, height=60)
        want = render(gaussians, crop, BACKGROUND)
        assert want.alpha.any()
        assert_same_image(Rendering(*(channel[part] for channel in got)), want, "float32_8192")
    assert not got.alpha[:1000, :1000].any()


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
@pytest.mark.parametrize("name", ["random", *NAMES])
def test_float64_agrees_to_rounding(name: str, options: RasterizerOptions):
    gaussians, camera = random_scene(8, 200) if name == "random" else ADVERSARIAL[name]()
    gaussians = as_dtype(gaussians, np.float64)
    got = draw(gaussians, camera, background=BACKGROUND, options=options)
    assert got.rgb.dtype == np.float64
    assert_same_image(got, render(gaussians, camera, BACKGROUND, options, depth_band=0.0), "float64")


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

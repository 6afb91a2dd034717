"""Laws that hold for every scene, tested without a reference image."""

import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from msdgs_serve.rasterizer import GSPLAT, INRIA, Rendering, rasterize
from msdgs_serve.rasterizer.projection import project
from msdgs_serve.rasterizer.tiles import SPLATS_PER_PART, TooManyPairs, bin_into_tiles
from msdgs_serve.scene import Camera, Gaussians, InvalidInput, Region
from msdgs_serve.scene.quaternion import from_matrix, to_matrix
from tests.support import reference
from tests.support.scenes import as_dtype, draw, front_camera, gaussians_of, joined, random_scene, select, unit_quats
from tests.support.tolerances import assert_close

BACKGROUND = np.array([0.2, 0.6, 0.9])
DTYPES = pytest.mark.parametrize("dtype", [np.float32, np.float64], ids=["float32", "float64"])
SEEDS = pytest.mark.parametrize("seed", [20, 21])


def scene(seed: int, dtype: type, count: int = 150) -> tuple[Gaussians, Camera]:
    gaussians, camera = random_scene(seed, count)
    return as_dtype(gaussians, dtype), camera


def assert_same(got: Rendering, want: Rendering, clear: np.ndarray | None = None):
    """Check that images agree within the rounding of their dtype at the pixels of `clear` (all by default)."""
    row = got.rgb.dtype.name
    clear = np.ones(got.alpha.shape, bool) if clear is None else clear
    assert clear.mean() > 0.9
    for name in ("rgb", "alpha"):
        assert_close(getattr(got, name)[clear], getattr(want, name)[clear], f"{name}.{row}")
    seen = clear & np.isfinite(want.depth)
    np.testing.assert_array_equal(np.isfinite(got.depth)[clear], np.isfinite(want.depth)[clear])
    assert_close(got.depth[seen], want.depth[seen], f"depth.{row}.relative")


def assert_identical(got: Rendering, want: Rendering):
    for channel, expected in zip(got, want, strict=True):
        np.testing.assert_array_equal(channel, expected)


def clear_pixels(gaussians: Gaussians, camera: Camera) -> np.ndarray:
    """Return the pixels at which rounding can't change a decision."""
    return reference.render(gaussians, camera, BACKGROUND).slack == 0


@DTYPES
@SEEDS
def test_order_of_gaussians_does_not_matter(seed: int, dtype: type):
    gaussians, camera = scene(seed, dtype)
    order = np.random.default_rng(seed).permutation(len(gaussians))
    assert_identical(draw(select(gaussians, order), camera), draw(gaussians, camera))


@DTYPES
@pytest.mark.parametrize("factor", [0.25, 1024.0])
def test_scaling_scene_and_camera_changes_nothing(factor: float, dtype: type):
    """By powers of 2, which are exact; depth grows with the scene."""
    gaussians, camera = scene(20, dtype)
    pose = camera.camera_to_world.copy()
    pose[:3, 3] *= factor
    small = draw(gaussians, camera, background=BACKGROUND)
    scaled = replace(gaussians, means=gaussians.means * dtype(factor), scales=gaussians.scales * dtype(factor))
    large = draw(scaled, replace(camera, camera_to_world=pose), background=BACKGROUND)
    assert_identical(large._replace(depth=large.depth / factor), small)


@DTYPES
def test_further_channels_change_no_other_channel(dtype: type):
    gaussians, camera = scene(22, dtype)
    plain = rasterize(gaussians, camera, background=BACKGROUND)
    assert plain.depth.shape == plain.counts.shape == (0, 0)
    with_depth = draw(gaussians, camera, background=BACKGROUND)
    np.testing.assert_array_equal(with_depth.rgb, plain.rgb)
    np.testing.assert_array_equal(with_depth.alpha, plain.alpha)


def rotated(gaussians: Gaussians, camera: Camera, rotation: np.ndarray) -> tuple[Gaussians, Camera]:
    """Move world and camera rigidly; harmonics are rotated by a fit."""
    directions = np.random.default_rng(0).normal(size=(100, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    before, after = (reference.sh_basis(d, 3) for d in (directions @ rotation, directions))
    harmonics = np.linalg.lstsq(after, before, rcond=None)[0]  # value at rotation @ d is the old one at d
    translation = np.array([0.7, -0.3, 0.4])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, translation
    moved = Gaussians(
        means=gaussians.means @ rotation.T + translation,
        quats=from_matrix(rotation @ to_matrix(gaussians.quats)),
        scales=gaussians.scales,
        opacities=gaussians.opacities,
        sh=np.einsum("jk,nkc->njc", harmonics, gaussians.sh),
    )
    return moved, replace(camera, camera_to_world=pose @ camera.camera_to_world)


@SEEDS
def test_moving_world_and_camera_together_changes_nothing(seed: int):
    gaussians, camera = scene(seed, np.float64)
    quats = gaussians.quats / np.linalg.norm(gaussians.quats, axis=1, keepdims=True)
    gaussians = replace(gaussians, quats=quats)
    moved = rotated(gaussians, camera, to_matrix(unit_quats(np.random.default_rng(seed), 1)[0]))
    assert_same(draw(*moved, background=BACKGROUND), draw(gaussians, camera, background=BACKGROUND))


@DTYPES
def test_sign_of_quaternions_does_not_matter(dtype: type):
    gaussians, camera = scene(20, dtype)
    negated = replace(gaussians, quats=-gaussians.quats)
    assert_identical(draw(negated, camera), draw(gaussians, camera))


@pytest.mark.parametrize("options", [GSPLAT, INRIA], ids=["gsplat", "inria"])
@DTYPES
def test_opaque_front_hides_all(dtype: type, options):
    """Two huge splats of opacity 1: the first leaves 1 - alpha_max; the second would end the pixel and isn't drawn."""
    behind, camera = gaussians_of([[0, 0, 4], [0.2, 0, 5], [-0.3, 0.2, 6]], scales=0.5, dtype=dtype), front_camera()
    front = gaussians_of([[0, 0, 2], [0, 0, 2.5]], scales=1e4, opacities=1.0, rgb=[0.1, 0.7, 0.3], dtype=dtype)
    options = options._replace(transmittance_min=(1 - options.alpha_max) ** 2 * 2)
    alone = draw(front, camera, background=BACKGROUND, options=options)
    assert_identical(draw(joined(behind, front), camera, background=BACKGROUND, options=options), alone)
    want = options.alpha_max * np.array([0.1, 0.7, 0.3]) + (1 - options.alpha_max) * BACKGROUND
    assert_close(alone.rgb, np.broadcast_to(want, alone.rgb.shape), "rgb.float32")
    assert_close(alone.depth, np.full(alone.depth.shape, 2.0), "depth.float32.relative")


@DTYPES
@SEEDS
def test_background_shows_through_what_is_left(seed: int, dtype: type):
    """rgb(background) = rgb(black) + (1 - alpha) background; alpha and depth don't depend on it."""
    gaussians, camera = scene(seed, dtype)
    over, black = draw(gaussians, camera, background=BACKGROUND), draw(gaussians, camera)
    assert_close(over.rgb, black.rgb + (1 - black.alpha)[..., None] * BACKGROUND, f"rgb.{np.dtype(dtype).name}")
    assert_identical(over._replace(rgb=black.rgb), black)


@DTYPES
@SEEDS
def test_alpha_is_the_weight_of_all_splats(seed: int, dtype: type):
    """White Gaussians over black: the color is the sum of the weights."""
    gaussians, camera = scene(seed, dtype)
    white = np.full((len(gaussians), 1, 3), 0.5 / 0.28209479177387814, dtype)
    image = draw(replace(gaussians, sh=white), camera)
    for channel in range(3):
        assert_close(image.rgb[..., channel], image.alpha, f"rgb.{np.dtype(dtype).name}")
    assert image.alpha.min() >= 0
    assert image.alpha.max() <= 1


@DTYPES
def test_crops_show_the_same_pixels(dtype: type):
    """Moving the principal point cuts the image; means stay inside all crops, where no Jacobian is clamped."""
    rng = np.random.default_rng(22)
    means = np.column_stack([rng.uniform(-0.15, 0.15, size=(40, 2)), rng.uniform(1.5, 3, 40)])
    gaussians = gaussians_of(means, scales=rng.uniform(0.02, 1.5, 40), opacities=0.4, dtype=dtype)
    camera = front_camera(64, 48)
    whole = draw(gaussians, camera, background=BACKGROUND)
    clear = clear_pixels(gaussians, camera)
    for left, top, width, height in ((0, 0, 37, 29), (27, 0, 37, 31), (0, 19, 40, 29), (25, 17, 13, 11)):
        crop = replace(camera, cx=camera.cx - left, cy=camera.cy - top, width=width, height=height)
        part = np.s_[top : top + height, left : left + width]
        expected = Rendering(*(channel[part] for channel in whole))
        assert_same(draw(gaussians, crop, background=BACKGROUND), expected, clear[part])


@DTYPES
@pytest.mark.parametrize("max_pairs", [1, 300])
def test_an_image_drawn_in_parts_is_the_same(monkeypatch: pytest.MonkeyPatch, max_pairs: int, dtype: type):
    gaussians, camera = scene(21, dtype)
    extra = np.random.default_rng(0).uniform(size=(len(gaussians), 2)).astype(dtype)
    all_channels = {"background": BACKGROUND, "extra": extra, "counts": True}
    whole = draw(gaussians, camera, **all_channels)
    monkeypatch.setattr(sys.modules[rasterize.__module__], "MAX_PAIRS", max_pairs)
    assert_identical(draw(gaussians, camera, **all_channels), whole)
    assert [channel.shape for channel in draw(gaussians, camera)] == [
        *(channel.shape for channel in whole[:3]), (*whole.alpha.shape, 0), (0, 0)
    ]  # fmt: skip


def cut(whole: Rendering, region: Region) -> Rendering:
    """Return the part of each image that a region shows."""
    return Rendering(*(image[region.y : region.bottom, region.x : region.right] for image in whole))


@DTYPES
@pytest.mark.parametrize("count", [150, 2 * SPLATS_PER_PART])
@pytest.mark.parametrize(
    "change",
    [{}, {"model": "fisheye", "distortion": (0.1, 0.02, 0.0, 0.0)}, {"model": "orthographic"}],
    ids=["pinhole", "fisheye", "orthographic"],
)
def test_a_region_is_a_part_of_the_image(change: dict[str, Any], count: int, dtype: type):
    gaussians, camera = scene(20, dtype, count)
    camera = replace(camera.resized(93, 71), **change)
    random = np.random.default_rng(0)
    extra = random.uniform(size=(count, 2)).astype(dtype)
    channels = {"background": BACKGROUND, "depth": True, "extra": extra, "counts": True}
    options = (GSPLAT, INRIA, GSPLAT._replace(eps2d=0.1, mip=True))[int(random.integers(3))]
    whole = rasterize(gaussians, camera, options=options, **channels)
    corners = [random.integers((93, 71), endpoint=True, size=(2, 2)) for _ in range(6)]
    regions = [
        Region(16, 16, 32, 48), Region(92, 70, 1, 1), Region.whole(camera),
        *(Region(*map(int, (*a.min(0), *np.ptp(a, axis=0)))) for a in corners if np.ptp(a, axis=0).all()),
    ]  # fmt: skip
    for region in regions:
        assert_identical(rasterize(gaussians, camera, options=options, region=region, **channels), cut(whole, region))


@DTYPES
def test_regions_of_a_huge_image_fit_together(monkeypatch: pytest.MonkeyPatch, dtype: type):
    """At the far corner of an image of 16,384 × 8,192 pixels, whole tiles or not, drawn in parts or at once."""
    gaussians, camera = scene(20, dtype, 2_000)
    camera = camera.resized(16_384, 8_192)
    seen = camera.project(gaussians.means)[0]
    x, y = (int(value) for value in np.clip(seen[seen[:, 0] > 8_192].mean(axis=0), 0, (16_000, 8_000)))
    whole = rasterize(gaussians, camera, region=Region(x, y, 150, 130))
    assert whole.alpha.max() > 0
    for left, top, right, bottom in ((0, 0, 61, 33), (61, 0, 150, 33), (0, 33, 61, 130), (61, 33, 150, 130)):
        region = Region(x + left, y + top, right - left, bottom - top)
        part = rasterize(gaussians, camera, region=region)
        for got, want in zip(part[:2], whole[:2], strict=True):
            np.testing.assert_array_equal(got, want[top:bottom, left:right])
    monkeypatch.setattr(sys.modules[rasterize.__module__], "MAX_PAIRS", 50)
    np.testing.assert_array_equal(rasterize(gaussians, camera, region=Region(x, y, 150, 130)).rgb, whole.rgb)


@pytest.mark.parametrize(
    "region", [(0, 0, 0, 5), (-1, 0, 5, 5), (60, 0, 5, 5), (0, 45, 5, 4), (0.0, 0, 5, 5), (0, 0, 5, True)]
)
def test_a_region_outside_of_the_image_is_refused(region: tuple[Any, ...]):
    gaussians, camera = scene(20, np.float32)
    with pytest.raises(InvalidInput, match="region"):
        rasterize(gaussians, camera.resized(64, 48), region=Region(*region))


@pytest.mark.parametrize("count", [10, SPLATS_PER_PART])
def test_lists_beyond_the_limit_are_not_made(count: int):
    """Each splat covers all tiles. The list of a single tile is made in any case."""
    gaussians = gaussians_of([[0, 0, 2]] * count, scales=10)
    splats, of_one_tile = (project(gaussians, front_camera(*size), GSPLAT) for size in ((53, 37), (16, 16)))
    assert len(bin_into_tiles(splats, 53, 37, 12 * count).splat_ids) == 12 * count
    with pytest.raises(TooManyPairs):
        bin_into_tiles(splats, 53, 37, 12 * count - 1)
    assert len(bin_into_tiles(of_one_tile, 16, 16, 1).splat_ids) == count


@SEEDS
def test_mirrored_image(seed: int):
    """The world seen in a mirror at x = 0, by a camera on the axis, is the image flipped left to right."""
    gaussians, _ = scene(seed, np.float64)
    quats = gaussians.quats / np.linalg.norm(gaussians.quats, axis=1, keepdims=True)
    gaussians = replace(gaussians, means=gaussians.means + np.array([0, 0, 4]), quats=quats, sh=gaussians.sh[:, :1])
    mirrored = replace(gaussians, means=gaussians.means * [-1, 1, 1], quats=quats * [1, 1, -1, -1])
    image, camera = draw(gaussians, front_camera()), front_camera()
    flipped = draw(mirrored, camera)
    assert_same(Rendering(*(channel[:, ::-1] for channel in flipped)), image)


@DTYPES
def test_invisible_gaussians_change_no_byte(dtype: type):
    """Opacity 0 or below the threshold, behind the camera, outside of the image."""
    gaussians, camera = scene(20, dtype)
    forward, right = camera.camera_to_world[:3, 2], camera.camera_to_world[:3, 0]
    middle = camera.position + 2 * forward
    means = [middle, middle, camera.position - forward, middle + 30 * right]
    hidden = gaussians_of(means, scales=0.1, opacities=[0, 0.0039, 1, 1], dtype=dtype)
    hidden = replace(hidden, sh=np.pad(hidden.sh, ((0, 0), (0, 15), (0, 0))))
    assert_identical(draw(joined(hidden, gaussians), camera), draw(gaussians, camera))


@DTYPES
@pytest.mark.parametrize("channels", [1, 3, 5])
def test_extra_channels_are_drawn_as_colors_are(channels: int, dtype: type):
    """Each channel as the red of the same Gaussians, over black; depth is measured along the camera's axis."""
    gaussians, camera = scene(20, dtype)
    extra = np.random.default_rng(0).uniform(-1, 1, size=(len(gaussians), channels)).astype(dtype)
    got = draw(gaussians, camera, background=BACKGROUND, extra=extra)
    plain = draw(gaussians, camera, background=BACKGROUND)
    for name in ("rgb", "alpha", "depth"):
        np.testing.assert_array_equal(getattr(got, name), getattr(plain, name))
    assert plain.extra.shape == (camera.height, camera.width, 0)
    assert got.extra.shape == (camera.height, camera.width, channels)
    for channel in range(channels):
        shifted = np.zeros((len(gaussians), 1, 3), dtype)
        shifted[:, 0, 0] = (extra[:, channel] + 2 - 0.5) * np.sqrt(4 * np.pi)  # colors can't be below 0
        red = draw(replace(gaussians, sh=shifted), camera).rgb[:, :, 0]
        assert_close(got.extra[:, :, channel], red - 2 * plain.alpha, f"rgb.{np.dtype(dtype).name}")


@pytest.mark.parametrize("bad", [np.zeros((3, 1)), np.zeros(150), np.full((150, 1), np.nan)])
def test_extra_channels_that_cannot_be(bad: np.ndarray):
    gaussians, camera = scene(20, np.float32)
    with pytest.raises(InvalidInput, match="extra"):
        draw(gaussians, camera, extra=bad)

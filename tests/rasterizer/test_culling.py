"""Blocks of static Gaussians that a camera can't see are left out, and change no bit of a frame."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from msdgs_serve.rasterizer import GSPLAT, INRIA, RasterizerOptions, rasterize
from msdgs_serve.rasterizer.culling import seen_blocks
from msdgs_serve.rasterizer.projection import project
from msdgs_serve.rasterizer.view import view_of
from msdgs_serve.scene import Camera, Gaussians, InvalidInput, Region
from msdgs_serve.scene.quaternion import to_matrix
from msdgs_serve.scene.static_bounds import BLOCK, static_bounds
from tests.support.scenes import as_dtype, random_scene, select, unit_quats


def in_order(count: int, dtype: type) -> tuple[Gaussians, Camera]:
    """A seeded scene, neighbors in space after each other, and a camera."""
    gaussians, camera = random_scene(20, count)
    return as_dtype(select(gaussians, np.lexsort(np.floor(gaussians.means * 2).T)), dtype), camera


def views(camera: Camera, count: int) -> Iterator[Camera]:
    """Cameras outside and inside, of all models."""
    random = np.random.default_rng(1)
    for k in range(count):
        pose = np.eye(4)
        pose[:3, :3] = to_matrix(unit_quats(random, 1))[0]
        pose[:3, 3] = random.normal(scale=(0.3, 2, 6)[k % 3], size=3)
        model = ("pinhole", "orthographic", "fisheye")[k % 5 % 3]
        yield replace(camera, camera_to_world=pose, model=model, cx=camera.cx + random.normal(scale=20))


@pytest.mark.parametrize("dtype", [np.float32, np.float64], ids=["float32", "float64"])
@pytest.mark.parametrize("moving_count", [0, 300])
@pytest.mark.parametrize("options", [GSPLAT, INRIA._replace(mip=True)], ids=["gsplat", "inria"])
def test_frames_are_the_same(options: RasterizerOptions, moving_count: int, dtype: type):
    gaussians, camera = in_order(3_000, dtype)
    static, left_out = static_bounds(moving_count, gaussians.means[moving_count:], gaussians.scales[moving_count:]), 0
    for k, view in enumerate(views(camera, 12)):
        channels = {"region": (None, Region(17, 3, 14, 20))[k % 2], "options": options, "depth": True}
        whole = rasterize(gaussians, view, **channels)
        for got, want in zip(rasterize(gaussians, view, static=static, **channels), whole, strict=True):
            np.testing.assert_array_equal(got, want)
        left_out += int((seen_blocks(static, view_of(view, options), len(gaussians)) == 0).sum())
    assert left_out > 12, "at least one a view on average"


def test_few_blocks_hold_all_that_is_drawn():
    gaussians, camera = in_order(3 * BLOCK - 40, np.float32)
    static = static_bounds(0, gaussians.means, gaussians.scales)
    for view in views(camera, 4):
        splats = project(gaussians, view, GSPLAT)
        keys = np.concatenate([splats.keys[start:stop] for start, stop in splats.drawn])
        drawn = np.unique((keys & np.uint64(0xFFFFFFFF)) // np.uint64(BLOCK))
        seen = seen_blocks(static, view_of(view, GSPLAT), len(gaussians))
        assert seen[drawn].all()
        culled = project(gaussians, view, GSPLAT, static=static)
        assert culled.visible == splats.visible


@pytest.mark.parametrize(
    ("mean", "quat", "scales"),
    [
        ((-5.042, 0.0, 1.0), (0.0, 0.0, 1.0009, 0.0), (1.5, 1.5, 1.5)),
        ((-1e21, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0), (1e20, 1e-2, 1e-2)),
        ((0.0, 0.0, 0.01000001), (1.0, 0.0, 0.0, 0.0), (1e-4, 1e-4, 1e-4)),
    ],
    ids=["a quaternion of length 1.0009", "an extent that overflows", "at the near plane"],
)
def test_extreme_gaussians_are_left_out_only_if_they_are_not_drawn(mean: tuple, quat: tuple, scales: tuple):
    arrays = (mean, quat, scales, 1.0, np.ones((1, 3)))
    gaussians = Gaussians(*(np.array([each], np.float32) for each in arrays))
    camera = Camera(1000.0, 1000.0, 32.0, 32.0, 64, 64, np.eye(4))
    static = static_bounds(0, gaussians.means, gaussians.scales)
    whole = rasterize(gaussians, camera)
    np.testing.assert_array_equal(rasterize(gaussians, camera, static=static).rgb, whole.rgb)


def test_bounds_of_other_gaussians_are_refused():
    gaussians, camera = in_order(2_000, np.float32)
    static = static_bounds(0, gaussians.means, gaussians.scales)
    with pytest.raises(InvalidInput, match="static"):
        rasterize(select(gaussians, slice(300)), camera, static=static)


def test_a_scene_without_static_gaussians_has_no_blocks():
    gaussians, camera = in_order(300, np.float32)
    for moving_count in (300, 299):
        static = static_bounds(moving_count, gaussians.means[moving_count:], gaussians.scales[moving_count:])
        assert len(static.sizes) == 0
        frame = rasterize(gaussians, camera, static=static)
        np.testing.assert_array_equal(frame.rgb, rasterize(gaussians, camera).rgb)

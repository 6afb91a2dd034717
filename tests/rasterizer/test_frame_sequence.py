"""Frames of a camera that stands still are those that are drawn from nothing, bit by bit."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from msdgs_serve.rasterizer import GSPLAT, INRIA, FrameSequence, RasterizerOptions, Rendering, rasterize
from msdgs_serve.scene import Camera, Gaussians, InvalidInput, Region
from tests.support.scenes import as_dtype, joined, random_scene, select

BACKGROUND = (0.2, 0.6, 0.9)


def assert_identical(got: Rendering, want: Rendering):
    for channel, expected in zip(got, want, strict=True):
        np.testing.assert_array_equal(channel, expected)


def parts(seed: int, count: int, moving_count: int, dtype: type = np.float32) -> tuple[Gaussians, Gaussians, Camera]:
    """Return moving and static Gaussians and a camera."""
    gaussians, camera = random_scene(seed, count)
    gaussians = as_dtype(gaussians, dtype)
    order = np.arange(count)
    return select(gaussians, order[:moving_count]), select(gaussians, order[moving_count:]), camera


def moved(gaussians: Gaussians, random: np.random.Generator) -> Gaussians:
    shift = random.normal(scale=0.3, size=3).astype(gaussians.means.dtype)
    return replace(gaussians, means=gaussians.means + shift, opacities=gaussians.opacities * random.choice([0.5, 1.0]))


@pytest.mark.parametrize("dtype", [np.float32, np.float64], ids=["float32", "float64"])
@pytest.mark.parametrize("moving_count", [1, 20, 149, 150])
@pytest.mark.parametrize(
    ("options", "change"),
    [
        (GSPLAT, {}),
        (INRIA._replace(mip=True), {"model": "orthographic"}),
        (GSPLAT._replace(eps2d=0.1), {"model": "fisheye"}),
    ],
    ids=["pinhole", "orthographic", "fisheye"],
)
def test_frames_are_those_of_all_gaussians(
    options: RasterizerOptions, change: dict[str, Any], moving_count: int, dtype: type
):
    moving, static, camera = parts(30, 150, moving_count, dtype)
    camera, random = replace(camera.resized(93, 71), **change), np.random.default_rng(0)
    for region, depth in ((None, False), (None, True), (Region(13, 20, 50, 41), True)):
        constants = {"background": BACKGROUND, "depth": depth, "options": options, "region": region}
        sequence = FrameSequence(static, moving_count, camera, **constants)
        for _ in range(4):
            moving = moved(moving, random)
            assert_identical(sequence.frame(moving), rasterize(joined(moving, static), camera, **constants))


def test_of_equal_depths_the_moving_gaussian_is_in_front():
    moving, static, camera = parts(31, 40, 20)
    camera = camera.resized(37, 33)
    static = replace(moving, sh=static.sh)
    sequence = FrameSequence(static, len(moving), camera)
    assert_identical(sequence.frame(moving), rasterize(joined(moving, static), camera))


def test_moving_gaussians_that_are_not_seen_leave_the_image_as_it_is():
    moving, static, camera = parts(32, 60, 10)
    behind = replace(moving, means=moving.means + 100 * camera.camera_to_world[:3, 2].astype(np.float32) * -1)
    assert_identical(FrameSequence(static, 10, camera).frame(behind), rasterize(joined(behind, static), camera))


def test_wrong_values_are_named():
    moving, static, camera = parts(33, 60, 10)
    with pytest.raises(InvalidInput, match="background"):
        FrameSequence(static, 10, camera, background=(0.0, np.nan, 0.0))
    with pytest.raises(InvalidInput, match="region"):
        FrameSequence(static, 10, camera, region=Region(0, 0, 9999, 1))
    with pytest.raises(InvalidInput, match=r"gaussians\.means"):
        FrameSequence(replace(static, means=static.means * np.nan), 10, camera)
    sequence = FrameSequence(static, 10, camera)
    with pytest.raises(InvalidInput, match=r"gaussians\.scales"):
        sequence.frame(replace(moving, scales=-moving.scales))
    assert_identical(sequence.frame(moving), rasterize(joined(moving, static), camera))

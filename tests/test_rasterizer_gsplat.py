"""Projection, covariance and colours against gsplat's own plain torch reference: code that no one here wrote."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from msdgs_serve.rasterizer import GSPLAT, rasterize
from msdgs_serve.rasterizer.projection import (
    BLUE,
    DEPTH,
    GREEN,
    RED,
    ROOT_A,
    ROOT_B,
    ROOT_C,
    ROOT_SCALE,
    Splats,
    X,
    Y,
    project,
)
from msdgs_serve.scene import Camera, Gaussians
from tests import reference_torch
from tests.scenes import ADVERSARIAL, as_dtype, random_scene
from tests.tolerances import assert_close

SCENES = ["random", *sorted(ADVERSARIAL)]


def scene(name: str, dtype: type) -> tuple[Gaussians, Camera]:
    gaussians, camera = random_scene(11, 300) if name == "random" else ADVERSARIAL[name]()
    gaussians = as_dtype(gaussians, np.float64)
    quats = gaussians.quats / np.linalg.norm(gaussians.quats, axis=1, keepdims=True)  # as gsplat will do
    return as_dtype(replace(gaussians, quats=quats), dtype), camera


def gsplat_projection(gaussians: Gaussians, camera: Camera) -> reference_torch.Projection:
    arrays = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.sh)
    means, quats, scales, sh = (torch.from_numpy(array.astype(np.float64)) for array in arrays)
    return reference_torch.project(means, quats, scales, sh, camera)


def conics(splats: Splats) -> np.ndarray:
    """[N, 3] xx, xy, yy of the inverse covariance from its root [[a, b], [0, c]]."""
    a, b, c = splats.records[:, [ROOT_A, ROOT_B, ROOT_C]].astype(np.float64).T / ROOT_SCALE
    return np.stack([a * a, a * b, b * b + c * c], axis=1)


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_projection(name: str, dtype: type):
    gaussians, camera = scene(name, dtype)
    got, want = project(gaussians, camera, GSPLAT), gsplat_projection(gaussians, camera)
    drawn = got.extents[:, 0] > 0
    assert drawn.any()
    row = np.dtype(dtype).name
    assert_close(got.records[drawn, DEPTH], want.depths.numpy()[drawn], f"projection.{row}.relative")
    assert_close(got.records[drawn][:, [RED, GREEN, BLUE]], want.colors.numpy()[drawn], f"color.{row}")
    pixels = want.means2d.numpy()[drawn]
    size = np.maximum(np.abs(pixels), max(camera.width, camera.height))  # float32 has so many digits after the point
    assert_close(
        (got.records[drawn][:, [X, Y]] - pixels) / size + 1, np.ones_like(pixels), f"projection.{row}.relative"
    )
    inverse = want.conics.numpy()[drawn]
    size = np.sqrt(inverse[:, [0, 0, 2]] * inverse[:, [0, 2, 2]])  # of xy: the most that a covariance allows
    assert_close((conics(got)[drawn] - inverse) / size + 1, np.ones_like(inverse), f"conic.{row}.relative")


@pytest.mark.parametrize("name", SCENES)
def test_what_is_not_drawn_adds_nothing(name: str):
    gaussians, camera = scene(name, np.float64)
    splats = gsplat_projection(gaussians, camera)
    hidden = project(gaussians, camera, GSPLAT).extents[:, 0] == 0
    opacities = torch.from_numpy(gaussians.opacities)
    hidden_ones = reference_torch.Projection(*(values[hidden] for values in splats))
    _, alpha = reference_torch.render(hidden_ones, opacities[hidden], camera, torch.zeros(3).double())
    assert not alpha.any()


@pytest.mark.parametrize("name", ["random", "off_axis_89", "principal_point_outside", "inside_splat"])
def test_pictures(name: str):
    gaussians, camera = scene(name, np.float64)
    background = np.array([0.3, 0.1, 0.7])
    splats = gsplat_projection(gaussians, camera)
    opacities = torch.from_numpy(gaussians.opacities)
    rgb, alpha = reference_torch.render(splats, opacities, camera, torch.from_numpy(background))
    got = rasterize(gaussians, camera, background=background)
    assert_close(got.rgb, rgb.numpy(), "rgb.float64")
    assert_close(got.alpha, alpha.numpy(), "alpha.float64")

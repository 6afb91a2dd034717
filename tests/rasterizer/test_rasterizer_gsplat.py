"""Projection, covariance and colors against gsplat's torch reference."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from msdgs_serve.rasterizer import GSPLAT, rasterize
from msdgs_serve.rasterizer import splats as columns
from msdgs_serve.rasterizer.projection import project
from msdgs_serve.scene import Camera, Gaussians
from msdgs_serve.scene.quaternion import to_matrix
from tests.support import reference_torch
from tests.support.scenes import ADVERSARIAL, as_dtype, front_camera, gaussians_of, random_scene
from tests.support.tolerances import assert_close

SCENES = ["random", *sorted(ADVERSARIAL)]


def scene(name: str, dtype: type) -> tuple[Gaussians, Camera]:
    gaussians, camera = random_scene(11, 300) if name == "random" else ADVERSARIAL[name]()
    gaussians = as_dtype(gaussians, np.float64)
    quats = gaussians.quats / np.linalg.norm(gaussians.quats, axis=1, keepdims=True)  # as gsplat does
    return as_dtype(replace(gaussians, quats=quats), dtype), camera


def gsplat_projection(gaussians: Gaussians, camera: Camera) -> reference_torch.Projection:
    arrays = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.sh)
    means, quats, scales, sh = (torch.from_numpy(array.astype(np.float64)) for array in arrays)
    return reference_torch.project(means, quats, scales, sh, camera)


def conics(splats: columns.Splats) -> np.ndarray:
    """[N, 3] xx, xy, yy of the inverse covariance from its root [[a, b], [0, c]]."""
    a, b, c = (
        splats.records[:, [columns.ROOT_A, columns.ROOT_B, columns.ROOT_C]].astype(np.float64).T / columns.ROOT_SCALE
    )
    return np.stack([a * a, a * b, b * b + c * c], axis=1)


def assert_conics(splats: columns.Splats, inverse: np.ndarray, row: str):
    """Compare relative to the diagonal of the inverse covariance, for xy to its upper bound √(xx yy)."""
    drawn = splats.extents[:, 0] > 0
    size = np.sqrt(inverse[drawn][:, [0, 0, 2]] * inverse[drawn][:, [0, 2, 2]])
    assert_close((conics(splats)[drawn] - inverse[drawn]) / size + 1, np.ones_like(size), row)


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_projection(name: str, dtype: type):
    gaussians, camera = scene(name, dtype)
    got, want = project(gaussians, camera, GSPLAT), gsplat_projection(gaussians, camera)
    drawn = got.extents[:, 0] > 0
    assert drawn.any()
    row = np.dtype(dtype).name
    assert_close(got.records[drawn, columns.DEPTH], want.depths.numpy()[drawn], f"projection.{row}.relative")
    assert_close(
        got.records[drawn][:, [columns.RED, columns.GREEN, columns.BLUE]], want.colors.numpy()[drawn], f"color.{row}"
    )
    pixels = want.means2d.numpy()[drawn]
    size = np.maximum(np.abs(pixels), max(camera.width, camera.height))  # float32's resolution of pixel coordinates
    assert_close(
        (got.records[drawn][:, [columns.X, columns.Y]] - pixels) / size + 1,
        np.ones_like(pixels),
        f"projection.{row}.relative",
    )
    assert_conics(got, want.conics.numpy(), f"conic.{row}.relative")


def of_model(model: str, camera: Camera) -> Camera:
    """A camera of another model with about the same image."""
    scale = 0.25 if model == "orthographic" else 1.0
    return replace(camera, model=model, fx=scale * camera.fx, fy=scale * camera.fy)


@pytest.mark.parametrize("model", ["orthographic", "fisheye"])
def test_other_cameras(model: str):
    """Without colors: gsplat takes an orthographic camera's viewing directions for those of a pinhole."""
    gaussians, camera = scene("random", np.float64)
    camera = of_model(model, camera)
    got, want = project(gaussians, camera, GSPLAT), gsplat_projection(gaussians, camera)
    drawn = got.extents[:, 0] > 0
    assert drawn.mean() > 0.5
    pixels = want.means2d.numpy()[drawn]
    assert_close(got.records[drawn][:, [columns.X, columns.Y]], pixels, "projection.gsplat_fisheye")
    assert_conics(got, want.conics.numpy(), "projection.gsplat_fisheye")
    assert_close(got.records[drawn, columns.DEPTH], want.depths.numpy()[drawn], "projection.float64.relative")
    exact, depths = camera.project(gaussians.means)
    assert_close(got.records[drawn][:, [columns.X, columns.Y]], exact[drawn], "pixel")
    assert_close(got.records[drawn, columns.DEPTH], depths[drawn], "projection.float64.relative")


def test_mip_dims_what_it_spreads():
    gaussians, camera = scene("random", np.float64)
    gaussians = replace(gaussians, scales=gaussians.scales * 0.3)
    got = project(gaussians, camera, GSPLAT._replace(mip=True))
    compensations = gsplat_projection(gaussians, camera).compensations.numpy()
    drawn = got.extents[:, 0] > 0
    assert 0.1 < np.median(compensations[drawn]) < 0.9
    dimmed = gaussians.opacities * compensations
    assert_close(2 ** got.records[drawn, columns.LOG2_OPACITY], dimmed[drawn], "conic.float64.relative")
    assert (dimmed[~drawn & (gsplat_projection(gaussians, camera).depths.numpy() > 1)] < GSPLAT.alpha_min).any()


def test_distorted_fisheye_is_its_formula():
    """Positions from the formula, footprints from its central differences."""
    gaussians, camera = scene("random", np.float64)
    k = (0.1, -0.05, 0.02, -0.01)
    camera = replace(camera, model="fisheye", distortion=k)
    world_to_camera = camera.world_to_camera
    points = gaussians.means @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]

    def pixels(points: np.ndarray) -> np.ndarray:
        radius = np.hypot(points[:, 0], points[:, 1])
        theta = np.arctan2(radius, points[:, 2])
        rho = theta * (1 + k[0] * theta**2 + k[1] * theta**4 + k[2] * theta**6 + k[3] * theta**8)
        return points[:, :2] * (rho / radius)[:, None] * [camera.fx, camera.fy] + [camera.cx, camera.cy]

    step = 1e-6
    slopes = [(pixels(points + step * axis) - pixels(points - step * axis)) / (2 * step) for axis in np.eye(3)]
    axes = to_matrix(gaussians.quats) * gaussians.scales[:, None, :]
    half_axes = np.stack(slopes, axis=2) @ world_to_camera[:3, :3] @ axes
    covariances = half_axes @ half_axes.swapaxes(1, 2) + GSPLAT.eps2d * np.eye(2)
    inverse = np.linalg.inv(covariances)[:, [0, 0, 1], [0, 1, 1]]
    got = project(gaussians, camera, GSPLAT)
    drawn = got.extents[:, 0] > 0
    assert drawn.mean() > 0.5
    assert_close(got.records[drawn][:, [columns.X, columns.Y]], pixels(points)[drawn], "pixel")
    assert_close(camera.project(gaussians.means)[0], pixels(points), "pixel")
    assert_conics(got, inverse, "conic.finite_differences")


@pytest.mark.parametrize(
    ("distortion", "fold"), [((-0.3, 0, 0, 0), 60.39), ((0, -0.1, 0, 0), 68.13), ((0.2, 1e-300, 0, 0), 90)]
)
def test_nothing_is_drawn_where_a_fisheye_folds_back(distortion: tuple[float, float, float, float], fold: float):
    """`fold` is the angle in degrees at which 1 + 3 k1 theta² + 5 k2 theta⁴ is 0."""
    degrees = np.arange(0.0, 90.0)
    around, angles = np.radians(100 * degrees), np.radians(degrees)
    means = np.column_stack([np.sin(angles) * np.cos(around), np.sin(angles) * np.sin(around), np.cos(angles)])
    camera = replace(front_camera(600, 600), fx=100.0, fy=100.0, model="fisheye", distortion=distortion)
    got = project(gaussians_of(means, scales=0.01, dtype=np.float64), camera, GSPLAT)
    np.testing.assert_array_equal(got.extents[:, 0] > 0, degrees < fold)


@pytest.mark.parametrize("model", ["orthographic", "fisheye"])
def test_a_point_on_the_axis_is_drawn_in_the_centre(model: str):
    gaussians = gaussians_of([[0, 0, 2.0]], scales=0.1, dtype=np.float64)
    camera = replace(front_camera(), model=model)
    got = project(gaussians, camera, GSPLAT)
    np.testing.assert_allclose(got.records[0, [columns.X, columns.Y]], [camera.cx, camera.cy], atol=1e-6)
    pixels = camera.fx * 0.1 / (2 if model == "fisheye" else 1)
    expected = 1 / (pixels**2 + GSPLAT.eps2d)
    np.testing.assert_allclose(conics(got)[0], [expected, 0, expected], rtol=1e-6, atol=1e-9)
    axis = gaussians_of([[0, 0, 0.0]], dtype=np.float64)
    assert project(axis, camera, GSPLAT).extents[0, 0] == 0


def test_orthographic_images_do_not_depend_on_distance():
    gaussians, camera = scene("random", np.float64)
    gaussians = replace(gaussians, sh=gaussians.sh[:, :4])
    camera = of_model("orthographic", camera)
    pose = camera.camera_to_world.copy()
    pose[:3, 3] -= 3 * pose[:3, 2]
    near, far = rasterize(gaussians, camera), rasterize(gaussians, replace(camera, camera_to_world=pose))
    assert near.alpha.max() > 0.5
    assert_close(far.rgb, near.rgb, "rgb.float64")

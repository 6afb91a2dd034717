"""Refined poses of training cameras: gradients, known errors that are found, and what a run keeps of them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from msdgs_serve.scene import Camera
from msdgs_serve.scene.camera import orbit
from msdgs_train.datasets import Frame
from msdgs_train.engine.run import fit
from msdgs_train.gaussians.model import PosedGaussians
from msdgs_train.layers.parameters import exponential
from msdgs_train.poses.config import PoseConfig
from msdgs_train.poses.refinement import DISTANCE, PoseRefinement
from msdgs_train.rendering.rasterize import rasterize
from tests.support.scenes import as_dtype, random_scene
from tests.support.tolerances import assert_close
from tests.support.training_scene import StopAfter, assert_same_bits, small_config, state_of

BACKGROUND = torch.tensor([0.2, 0.6, 0.9], dtype=torch.float64)
STEP = 1e-6
STEPS = 60
SETTINGS = PoseConfig()


def posed_scene(seed: int, count: int, sh_degree: int) -> tuple[PosedGaussians, Camera]:
    gaussians, camera = random_scene(seed, count, sh_degree=sh_degree)
    g = as_dtype(gaussians, np.float64)
    quats = g.quats / np.linalg.norm(g.quats, axis=1, keepdims=True)
    return PosedGaussians(*map(torch.tensor, (g.means, quats, g.scales, g.opacities, g.sh))), camera


def frames_of(cameras: list[Camera]) -> list[Frame]:
    return [Frame(f"{i}", camera, i / len(cameras), Path(f"{i}.png")) for i, camera in enumerate(cameras)]


def moved(camera: Camera, twist: np.ndarray) -> Camera:
    """A camera that is turned around its center by a rotation vector, and moved; both in world axes."""
    pose = camera.camera_to_world.copy()
    pose[:3, :3] = Rotation.from_rotvec(twist[:3]).as_matrix() @ pose[:3, :3]
    pose[:3, 3] += DISTANCE * twist[3:]
    return replace(camera, camera_to_world=pose)


def test_the_gradient_in_a_pose_is_that_of_a_moved_camera() -> None:
    """Of Gaussians whose color is the same from all sides."""
    posed, camera = posed_scene(3, 20, sh_degree=0)
    poses = PoseRefinement(SETTINGS, frames_of([camera])).double()
    weights = torch.rand(camera.height, camera.width, 4, generator=torch.Generator().manual_seed(0)).double()

    def loss(gaussians: PosedGaussians, seen: Camera) -> torch.Tensor:
        rgb, alpha, _ = rasterize(*gaussians, seen, BACKGROUND)
        return (torch.cat([rgb, alpha[..., None]], dim=2) * weights).sum()

    loss(poses.seen(posed, camera), camera).backward()
    steps = STEP * np.eye(6)
    want = [float(loss(posed, moved(camera, s)) - loss(posed, moved(camera, -s))) / (2 * STEP) for s in steps]
    assert poses.twists.grad is not None
    largest = np.abs(want).max()
    assert_close(poses.twists.grad[0].numpy() / largest, want / largest, "gradient.finite_differences")


def test_a_refined_pose_draws_what_the_moved_camera_sees() -> None:
    posed, camera = posed_scene(5, 30, sh_degree=0)
    poses = PoseRefinement(SETTINGS, frames_of([camera])).double()
    twist = np.array([2e-3, -1e-3, 3e-3, 4e-3, -2e-3, 1e-3])
    with torch.no_grad():
        poses.twists[0] = torch.from_numpy(twist)
        refined, _, _ = rasterize(*poses.seen(posed, camera), camera, BACKGROUND)
        expected, _, _ = rasterize(*posed, moved(camera, twist), BACKGROUND)
    assert_close(refined.numpy(), expected.numpy(), "refined_pose")


@pytest.mark.slow
def test_known_errors_of_poses_are_found() -> None:
    """Of a known scene: where its points are seen, errors fall to a tenth."""
    posed, _ = posed_scene(7, 30, sh_degree=0)
    up = np.array([0.0, 0.0, 1.0])
    given = [Camera.from_fov(orbit(np.zeros(3), 4.0, 120.0 * i, 20.0, up), 24, 24, 40.0) for i in range(3)]
    errors = np.random.default_rng(0).uniform(-0.01, 0.01, (3, 6))
    true = [moved(camera, error) for camera, error in zip(given, errors - errors.mean(axis=0), strict=True)]
    images = [rasterize(*posed, camera, BACKGROUND)[0] for camera in true]
    frames = frames_of(given)
    poses = PoseRefinement(SETTINGS, frames).double()
    optimizer = torch.optim.Adam(poses.parameters())
    for step in range(STEPS):
        optimizer.param_groups[0]["lr"] = exponential(2e-3, 2e-4, step, STEPS)
        optimizer.zero_grad()
        for frame, image in zip(frames, images, strict=True):
            rgb, _, _ = rasterize(*poses.seen(posed, frame.camera), frame.camera, BACKGROUND)
            (rgb - image).square().mean().backward()
        optimizer.step()
        poses.center()
    found = [moved(camera, twist) for camera, twist in zip(given, poses.twists.detach().numpy(), strict=True)]

    def pixels(cameras: list[Camera]) -> np.ndarray:
        return np.stack([camera.project(posed.means.numpy())[0] for camera in cameras])

    before, after = (np.linalg.norm(pixels(c) - pixels(true), axis=2).mean() for c in (given, found))
    assert after < before / 10


def test_images_of_one_camera_share_a_pose_whose_mean_is_that_given() -> None:
    _, camera = posed_scene(3, 1, sh_degree=0)
    other = moved(camera, np.full(6, 0.1))
    poses = PoseRefinement(SETTINGS, frames_of([camera, other, camera]))
    assert poses.twists.shape == (2, 6)
    with torch.no_grad():
        poses.twists[0] = 1.0
    poses.center()
    assert torch.equal(poses.twists, torch.tensor([[0.5], [-0.5]]).expand(2, 6))


@pytest.mark.slow
@pytest.mark.usefixtures("no_curve")
def test_a_resumed_run_has_the_same_bits_and_its_model_no_part_of_the_corrections(data: Path, tmp_path: Path) -> None:
    config = small_config(pose_opt=True)
    fit(config, data, tmp_path / "whole")
    fit(config, data, tmp_path / "parts", observer=StopAfter(11))
    fit(config, data, tmp_path / "parts", resume=True)
    whole = state_of(tmp_path / "whole")
    assert_same_bits(whole, state_of(tmp_path / "parts"))
    assert bool(whole["/system/poses/twists"].any())
    fit(small_config(), data, tmp_path / "without")
    models = [torch.load(tmp_path / run / "model.pt", weights_only=True) for run in ("whole", "without")]
    assert models[0]["state"].keys() == models[1]["state"].keys()

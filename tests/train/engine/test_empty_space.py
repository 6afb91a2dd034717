"""Alpha where an image is transparent is part of the loss."""

from pathlib import Path

import numpy as np
import pytest
import torch

from msdgs_train.datasets import load_scene
from msdgs_train.engine.schedule import Schedule
from msdgs_train.rendering.rasterize import rasterize
from msdgs_train.systems.base import Target
from msdgs_train.systems.gaussian_splatting import GaussianSplatting
from tests.support.tolerances import tolerance
from tests.support.training_scene import small_config

WEIGHT = 3.0


def test_alpha_is_penalized_where_the_image_is_transparent(data: Path) -> None:
    scene = load_scene(data)
    frame, white = scene.splits["train"][0], torch.ones(3)
    rgba = frame.load_rgba().copy()
    rgba[: len(rgba) // 2, :, 3] = np.arange(rgba.shape[1])
    target = Target.over(rgba, white)
    with_weight, without = (
        GaussianSplatting(Schedule.from_config(small_config(empty_weight=weight)), scene) for weight in (WEIGHT, 0.0)
    )
    losses = [system.loss(frame, target, white, 0).loss.item() for system in (with_weight, without)]
    posed = without.model.pose(frame.t, deform=False, sh_degree=0)
    alpha = rasterize(*posed, frame.camera, white)[1].detach().double().numpy()
    expected = WEIGHT * ((1 - rgba[:, :, 3] / 255) * alpha).mean()
    assert expected > 0.01
    assert losses[0] - losses[1] == pytest.approx(expected, rel=10 * tolerance("float32.relative"))


def test_a_target_is_the_image_over_the_background() -> None:
    rgba = np.array([[[255, 0, 0, 255], [255, 0, 0, 0]]], np.uint8)
    target = Target.over(rgba, torch.tensor([0.0, 0.0, 1.0]))
    assert target.rgb.tolist() == [[[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]]
    assert target.transparency.tolist() == [[0.0, 1.0]]

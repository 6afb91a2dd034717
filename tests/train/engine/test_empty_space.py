"""Alpha of images is part of the loss."""

from pathlib import Path

import numpy as np
import pytest
import torch

from msdgs_train.datasets import load_scene
from msdgs_train.engine.schedule import Schedule
from msdgs_train.rendering.rasterize import rasterize
from msdgs_train.systems.base import Moment
from msdgs_train.systems.gaussian_splatting import GaussianSplatting
from msdgs_train.systems.targets import ImageFacts, Target
from tests.support.tolerances import tolerance
from tests.support.training_scene import small_config, training_image

WEIGHT = 3.0
MOMENT = Moment(0, torch.Generator())


def test_alpha_is_compared_with_that_of_the_image(data: Path) -> None:
    scene = load_scene(data)
    frame, white = scene.splits["train"][0], torch.ones(3)
    rgba = frame.load_rgba().copy()
    rgba[: len(rgba) // 2, :, 3] = np.arange(rgba.shape[1])
    target = Target.over(training_image(rgba), white)
    with_weight, without = (
        GaussianSplatting(Schedule.from_config(small_config(alpha_weight=weight)), scene) for weight in (WEIGHT, 0.0)
    )
    losses = [system.loss(frame, target, white, MOMENT).loss.item() for system in (with_weight, without)]
    posed = without.model.pose(frame.t, deform=False, sh_degree=0)
    alpha = rasterize(*posed, frame.camera, white)[1].detach().double().numpy()
    expected = WEIGHT * np.abs(rgba[:, :, 3] / 255 - alpha).mean()
    assert expected > 0.01
    assert losses[0] - losses[1] == pytest.approx(expected, rel=10 * tolerance("float32.relative"))


def test_a_target_is_the_image_over_the_background() -> None:
    rgba = np.array([[[255, 0, 0, 255], [255, 0, 0, 0]]], np.uint8)
    target = Target.over(training_image(rgba), torch.tensor([0.0, 0.0, 1.0]))
    assert target.rgb.tolist() == [[[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]]
    assert float(target.alpha_error(torch.tensor([[0.5, 0.25]]))) == pytest.approx(0.375)
    opaque = Target.over(training_image(rgba[:, :1]), torch.zeros(3))
    assert float(opaque.alpha_error(torch.zeros(1, 1))) == 0


def test_an_image_with_an_empty_border_shows_everything() -> None:
    rgba = np.zeros((5, 6, 4), np.uint8)
    rgba[1:-1, 1:-1, 3] = 255
    assert ImageFacts.of(rgba).shows_all
    for place in ((0, 3), (4, 3), (2, 0), (2, 5)):
        cut = rgba.copy()
        cut[(*place, 3)] = 1
        assert not ImageFacts.of(cut).shows_all
    assert not ImageFacts.of(np.zeros_like(rgba)).shows_all, "all of it may be outside"


def test_with_an_opacity_head_an_image_never_shows_everything(data: Path) -> None:
    """A Gaussian may be transparent at the image's time alone."""
    scene, white = load_scene(data), torch.ones(3)
    frame = scene.splits["train"][0]
    rgba = frame.load_rgba().copy()
    rgba[[0, -1]] = rgba[:, [0, -1]] = 0
    rgba[1:-1, 1:-1, 3] = 255
    shown = [
        GaussianSplatting(Schedule.from_config(small_config(opacity_head=head)), scene)
        .loss(frame, Target.over(training_image(rgba), white), white, MOMENT)
        .shows_all
        for head in (False, True)
    ]
    assert shown == [True, False]

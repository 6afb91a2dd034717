"""Spline layers: curves, initialization, extrapolation beyond the time window, and temporal smoothness."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from msdgs_train.datasets import Frame, SceneData
from msdgs_train.engine.schedule import Schedule
from msdgs_train.layers.base import PAPER_HEADS, SceneBounds
from msdgs_train.layers.bodies import BodiesConfig
from msdgs_train.layers.spline import SplineConfig, SplineLayer
from msdgs_train.supports.nodes import NodesSupport
from msdgs_train.systems.gaussian_splatting import GaussianSplatting
from tests.support.models import NODES, SPLINE, random_model
from tests.support.reference_deformation import plain_step
from tests.support.scenes import front_camera
from tests.support.tolerances import assert_close, tolerance
from tests.support.training_scene import SPLINES, small_config

EXACT = tolerance("rotation")


def layer_of(count: int = 3, knots: int = 5, time_range: tuple[float, float] = (0.0, 1.0)) -> SplineLayer:
    layer = SplineLayer(SplineConfig(num_knots=knots), count, time_range).double()
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in layer.parameters():
            parameter.add_(0.3 * torch.randn(parameter.shape, generator=generator, dtype=torch.float64))
    return layer


def time(t: float) -> torch.Tensor:
    return torch.tensor(t, dtype=torch.float64)


@pytest.mark.parametrize("t", [2.0, 2.013, 3.1, 4.49, 4.5, 1.0, 7.0])
def test_motions_are_on_splines(t: float) -> None:
    layer, nodes = layer_of(time_range=(2.0, 4.5)), torch.randn(3, 3, dtype=torch.float64)
    step, want = layer(nodes, time(t)), plain_step(layer, nodes.numpy(), t)
    assert_close(step.delta_means.detach(), want.means, "rotation")
    assert_close(step.delta_scales.detach(), want.scales, "rotation")
    assert_close(step.delta_quats.detach(), want.quats, "rotation")
    assert torch.equal(step.weight, torch.ones(3, 1, dtype=torch.float64))


@pytest.mark.parametrize("config", [SplineConfig(num_knots=40), BodiesConfig(num_knots=40)])
def test_beyond_the_window_translations_and_rotations_continue(config: SplineConfig | BodiesConfig) -> None:
    layer = config.build(SceneBounds(), PAPER_HEADS, 1)
    angles = 0.1 * torch.arange(43)
    paths = torch.stack([torch.arange(43.0), -2 * torch.arange(43.0), (torch.arange(43.0) - 15) ** 2], dim=1)
    with torch.no_grad():
        layer.transls[:, 0] = paths
        for curve in layer.held_curves:
            curve[:] = torch.arange(43.0)[:, None, None]
        layer.rots[:, 0] = torch.stack([(angles / 2).cos(), 0 * angles, 0 * angles, (angles / 2).sin()], dim=1)
    known = layer.rots.detach().clone()
    layer.on_window(0.1, 0.2)
    inside = [k for k in range(43) if abs((k - 1) / 40 - 0.5) <= 0.2 + 0.5 / 40]
    first, last = inside[0], inside[-1]
    places = torch.arange(43).clamp(first - 3, last + 3)
    want = paths.clone()
    for end, away, inward in ((first, range(first), 1), (last, range(last + 1, 43), -1)):
        speed = (paths[end + inward] - paths[end + 3 * inward]) / 2
        for k in away:
            want[k] = paths[end] + abs(int(places[k]) - end) * speed
    assert torch.equal(layer.transls.detach()[:, 0], want)
    assert float((layer.rots.detach() - known[places]).abs().max()) <= tolerance("float32.relative")
    for curve in layer.held_curves:
        assert torch.equal(curve.detach()[:, 0, 0], torch.arange(43.0).clamp(first, last))


def test_motions_of_few_knots_are_held_beyond_the_window() -> None:
    layer = layer_of(2, 40)
    layer.on_window(0.0, 0.03)
    inside = [k for k in range(43) if abs((k - 1) / 40 - 0.5) <= 0.03 + 0.5 / 40]
    assert (layer.transls[: inside[0]] == layer.transls[inside[0]]).all()
    assert (layer.transls[inside[-1] :] == layer.transls[inside[-1]]).all()


def test_straight_motion_is_smooth() -> None:
    layer = SplineLayer(SplineConfig(num_knots=6), 2, (0.0, 1.0)).double()
    with torch.no_grad():
        layer.transls[:] = torch.arange(9.0)[:, None, None]
        assert float(layer.temporal_smoothness(time(0.5))) <= EXACT
        layer.transls[5, 0, 1] += 0.6
        assert float(layer.temporal_smoothness(time(0.5))) == pytest.approx((0.6 + 1.2) / (2 * 2 * 3))
        assert float(layer.temporal_smoothness(time(0.1))) <= EXACT
        weighted = layer.regularizers(torch.zeros(2, 3), time(0.5), torch.Generator())
        assert float(weighted["motion_smoothness"]) == pytest.approx(0.2 * (0.6 + 1.2) / (2 * 2 * 3))


def test_rigid_motions_stay_rigid() -> None:
    model = random_model(20, layers=(replace(SPLINE, affine=False),), support=NODES, embedding_dim=0).double()
    assert not any("stretches" in name for name, _ in model.named_parameters())
    assert isinstance(model.support, NodesSupport)
    matrices = model.support.motions(model.deformation, model.support.nodes, time(0.3))[:, :9].view(-1, 3, 3).detach()
    assert float((matrices @ matrices.transpose(1, 2) - torch.eye(3)).abs().max()) <= EXACT


@pytest.mark.parametrize(("cameras", "times", "knots"), [(1, 50, 0), (2, 50, 50), (3, 10, 36), (2, 130, 120)])
def test_splines_follow_each_time_that_fixed_cameras_capture(cameras: int, times: int, knots: int) -> None:
    poses = [np.eye(4) + np.eye(4, k=3) * index for index in range(cameras)]
    views = [replace(front_camera(), camera_to_world=pose) for pose in poses]
    frames = [Frame(f"{i}_{k}", view, i / times, Path()) for i in range(times) for k, view in enumerate(views)]
    layers = (SplineConfig(), SplineConfig(num_knots=5))
    schedule = Schedule.from_config(small_config(model=replace(SPLINES, layers=layers)))
    model = GaussianSplatting(schedule, SceneData({"train": frames}, 1.0)).model
    assert [layer.num_knots for layer in model.config.layers if isinstance(layer, SplineConfig)] == [knots, 5]

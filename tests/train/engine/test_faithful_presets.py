"""The published loops: their schedules, rates, initialization, regularizers and sizes."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from msdgs_train.datasets import load_scene
from msdgs_train.engine.config import TrainConfig
from msdgs_train.engine.schedule import Schedule
from msdgs_train.engine.trainer import Trainer
from msdgs_train.gaussians.model import DynamicGaussians, PosedGaussians
from msdgs_train.gaussians.model_file import load_model
from msdgs_train.gaussians.modulation import Modulation
from msdgs_train.layers.mlp import MLPConfig, MLPLayer
from msdgs_train.layers.parameters import LearningRate
from msdgs_train.layers.plane import PlaneConfig, PlaneGrid, PlaneLayer
from msdgs_train.systems.registry import preset
from tests.support.tolerances import tolerance
from tests.support.training_scene import PLANE, shrunk, small_config, splatting

DEFORMGS = ("deformgs-faithful", "msdgs-mlp-faithful", "msdgs-plane-faithful")


def rate(config: TrainConfig, init: float, final: float, step: int, *, until: float = 1.0, holds: bool = True) -> float:
    """Of a step, counted from 0."""
    return Schedule.from_config(config).rate(LearningRate(init, final, holds, until), step)


@pytest.mark.parametrize("name", DEFORMGS)
def test_the_loop_of_deformable_3d_gaussians(name: str) -> None:
    config = preset(name)
    schedule = Schedule.from_config(config)
    assert config.run.steps == 40_000
    assert not schedule.is_windowed(10_000)
    assert [schedule.deforms(step) for step in (2_998, 2_999)] == [False, True]
    assert [step for step in range(1, 20_000) if schedule.refines_at(step)] == list(range(600, 15_000, 100))
    assert [step for step in range(1, 20_000) if schedule.resets_at(step)] == [3_000, 6_000, 9_000, 12_000]
    assert rate(config, 8e-4, 1.6e-6, 0) == 8e-4
    assert rate(config, 8e-4, 1.6e-6, 20_000) == pytest.approx(math.sqrt(8e-4 * 1.6e-6))
    o = config.optimizer
    means = [rate(config, o.means_lr_init, o.means_lr_final, s, until=o.means_lr_until_fraction) for s in (0, 30_000)]
    assert means == [pytest.approx(8e-4), pytest.approx(8e-6)]
    assert (o.gradient_clip, config.density.absolute_gradients, config.density.grow_grad2d) == (None, True, 7e-4)
    assert config.model.scale_space == "linear"
    for layer in config.model.layers:
        assert isinstance(layer, MLPConfig | PlaneConfig)
        assert (layer.lr_init, layer.lr_final) == (8e-4, 1.6e-6)


def test_the_stages_of_4dgaussians_count_from_one() -> None:
    config = preset("4dgs-faithful")
    schedule = Schedule.from_config(config)
    rounds = [step for step in range(1, 23_001) if schedule.refines_at(step)]
    assert rounds == [*range(600, 3_001, 100), *range(3_600, 18_000, 100)]
    resets = [step for step in range(1, 23_001) if schedule.resets_at(step)]
    assert resets == [3_000, 6_000, 9_000, 12_000, 15_000]
    assert [rate(config, 1.0, 0.01, s) for s in (0, 3_000)] == [1.0, 1.0]
    assert rate(config, 1.0, 0.01, 13_000) == pytest.approx(0.1)
    assert config.density.max_gaussians == 360_000
    assert not schedule.has_reset(6_000)
    assert schedule.has_reset(6_001)


def test_adam_starts_again_with_motion(data: Path) -> None:
    config = shrunk(preset("4dgs-faithful")).updated(refine_every_fraction=0.0, reset_every_fraction=0.0)
    trainer = Trainer(config, load_scene(data))
    steps = []
    for _ in range(5):
        trainer.step()
        means = splatting(trainer).model.gaussians.means
        steps.append(int(trainer.optimizer.state[means]["step"]))
    assert trainer.schedule.restart_step == 3
    assert steps == [1, 2, 3, 1, 2]


def test_an_encoding_of_time_that_no_network_reads_stays_as_it_is(data: Path, tmp_path: Path) -> None:
    config = shrunk(preset("deformgs-faithful"))
    layers = [dataclasses.replace(layer, time_network=False) for layer in config.model.layers]
    trainer = Trainer(config.updated(layers=layers, static_fraction=0.0, time_noise=0.1), load_scene(data))
    (layer,) = splatting(trainer).model.deformation
    before = {name: values.clone() for name, values in layer.state_dict().items()}
    for _ in range(3):
        trainer.step()
    is_same = {name: torch.equal(values, before[name]) for name, values in layer.state_dict().items()}
    assert {name.split(".")[0] for name, same in is_same.items() if same} == {"time_hidden", "time_output"}
    splatting(trainer).save(tmp_path / "model.pt", 3)
    (loaded,) = load_model(tmp_path / "model.pt").model.deformation
    assert all(torch.equal(values, layer.state_dict()[name]) for name, values in loaded.state_dict().items())


def test_table_4_names_the_numbers_of_gaussians() -> None:
    """Published as 3.41 and 1.69 million, besides 1,155 of the network."""
    network = sum(p.numel() for p in Modulation().parameters())
    for name, millions, count in (("mlp", 3.41, 106_526), ("plane", 1.69, 52_776)):
        dim = preset(f"msdgs-{name}-faithful").model.embedding_dim
        numbers = [network + dim * n for n in (count - 155, count + 155)]
        assert [round(n / 1e6, 2) for n in numbers] == [millions] * 2
        assert [round((network + dim * n) / 1e6, 2) for n in (count - 158, count + 158)] != [millions] * 2
    assert preset("msdgs-plane-faithful").density.init_num_pts < 52_776 - 156
    assert preset("msdgs-mlp-faithful").density.init_num_pts == 100_000


def test_linears_start_as_published() -> None:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        layer = MLPLayer(MLPConfig(width=32, depth=3, time_width=16, initialization="torch"))
        plane = PlaneLayer(PlaneConfig(initialization="xavier"))
    for linear in (layer.time_hidden, layer.time_output, layer.first, *layer.trunk, layer.heads):
        assert isinstance(linear, torch.nn.Linear)
        bound = 1 / math.sqrt(linear.in_features)
        for values in (linear.weight.detach(), linear.bias.detach()):
            assert 0.8 * bound < float(values.abs().max()) <= bound
    for linear in (plane.features, *plane.hidden, *plane.heads):
        assert isinstance(linear, torch.nn.Linear)
        bound = math.sqrt(6 / (linear.in_features + linear.out_features))
        assert 0.8 * bound < float(linear.weight.detach().abs().max()) <= bound


def test_total_variation_as_in_hexplane() -> None:
    grid = PlaneGrid(3, 4, 5, 1.0, (0.0, 1.0)).double()
    with torch.no_grad():
        grid.time.normal_(generator=torch.Generator().manual_seed(0))
    expected = 0.0
    for planes, weights in ((grid.space, (1, 1)), (grid.time, (2, 1))):
        for plane in planes.detach().numpy():
            for axis, weight in enumerate(weights):
                expected += 2 * weight * float(np.mean(np.diff(plane, axis=axis) ** 2))
    assert grid.total_variation().item() == pytest.approx(expected, rel=tolerance("rotation"))
    layer = PlaneLayer(dataclasses.replace(PLANE, time_smoothness_weight=0.0, plane_tv_weight=0.0, tv_weight=3.0))
    terms = layer.regularizers(torch.zeros(1, 3), torch.tensor(0.5), torch.Generator())
    wanted = pytest.approx(3 * layer.plane_grids()[0].total_variation().item())
    assert {name: term.item() for name, term in terms.items()} == {"tv_0": wanted}


def test_smoothness_of_4dgaussians_is_along_the_second_axis() -> None:
    grid = PlaneGrid(2, 6, 5, 1.0, (0.0, 1.0)).double()
    second = np.diff(grid.space.detach().numpy(), n=2, axis=2)
    assert grid.plane_smoothness(one_axis=True).item() == pytest.approx(float(np.mean(second**2)))
    assert grid.plane_smoothness().item() > grid.plane_smoothness(one_axis=True).item()


def test_times_get_noise_that_falls_to_nothing(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = load_scene(data)
    config = small_config(time_noise=0.1, static_fraction=0.25, window_full_fraction=0.0)
    schedule = Schedule.from_config(config)
    assert [schedule.time_noise(step) for step in (0, 6, 12, 20)] == [0.0, pytest.approx(0.05), 0.0, 0.0]
    trainer, seen = Trainer(config, scene), []
    original = DynamicGaussians.pose

    def pose(model: DynamicGaussians, t: float, **how: Any) -> PosedGaussians:
        seen.append(t)
        return original(model, t, **how)

    monkeypatch.setattr(DynamicGaussians, "pose", pose)
    for _ in range(14):
        trainer.step()
    times = {frame.t for frame in scene.splits["train"]}
    assert [t in times for t in seen] == [True] * 6 + [False] * 6 + [True] * 2


def test_gray_gaussians_and_the_rasterizer_of_inria(data: Path) -> None:
    trainer = Trainer(shrunk(preset("deformgs-faithful")), load_scene(data))
    system = splatting(trainer)
    assert not system.model.gaussians.sh_dc.any()
    options = system._options(1)
    assert (options.near_plane, options.alpha_max) == (0.2, 0.99)

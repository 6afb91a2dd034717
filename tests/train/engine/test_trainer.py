"""Runs on a tiny scene: learning, stopping, and resuming with the same bits."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from msdgs_serve.scene import InvalidInput
from msdgs_serve.scene.spherical_harmonics import SH_C0
from msdgs_train.datasets import Frame, load_scene
from msdgs_train.density import config as density_module
from msdgs_train.density.gradient import GradientStrategy
from msdgs_train.engine import schedule as schedule_module
from msdgs_train.engine.config import TrainConfig
from msdgs_train.engine.gradients import average_gradients
from msdgs_train.engine.metrics_log import MetricsLog, read_metrics
from msdgs_train.engine.run import fit
from msdgs_train.engine.trainer import Trainer
from msdgs_train.evaluation.evaluate import evaluate_run
from msdgs_train.gaussians import scene_info
from msdgs_train.gaussians.config import ModelConfig
from msdgs_train.gaussians.model_file import load_model
from msdgs_train.gaussians.safe_load import CheckpointInvalid
from msdgs_train.layers.parameters import exponential
from msdgs_train.layers.plane import PlaneConfig, PlaneLayer
from msdgs_train.supports.nodes import NodesConfig
from msdgs_train.systems import gaussian_splatting as system_module
from msdgs_train.systems.base import Moment, Target, ViewLoss
from msdgs_train.systems.gaussian_splatting import GaussianSplatting
from tests.support.tolerances import tolerance
from tests.support.training_scene import (
    MLP,
    MODELS,
    PLANE,
    SIZE,
    StopAfter,
    assert_same_bits,
    learning_rates,
    small_config,
    splatting,
    state_of,
    trained,
)

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("found", [20, 500])
def test_sparse_points_of_a_dataset_are_the_first_gaussians(data: Path, found: int) -> None:
    numbers = np.random.default_rng(0)
    points, colors = numbers.uniform(-0.5, 0.5, (found, 3)), numbers.uniform(0.1, 0.9, (found, 3))
    scene = dataclasses.replace(load_scene(data), points=points, point_colors=colors)
    trainer = Trainer(small_config(), scene)
    first, started = splatting(trainer).model.gaussians, min(found, trainer.config.density.init_num_pts)
    assert 20 < trainer.config.density.init_num_pts < 500
    assert len(first) == started
    nearest = np.linalg.norm(first.means.detach().numpy()[:, None] - points[None], axis=2).argmin(axis=1)
    assert len(set(nearest)) == started
    np.testing.assert_allclose(first.means.detach(), points[nearest], atol=1e-6)
    np.testing.assert_allclose(first.sh_dc.detach()[:, 0] * SH_C0 + 0.5, colors[nearest], atol=1e-6)
    trainer.step()


@pytest.mark.parametrize(("given", "wanted"), [(None, 0.45 * SIZE * SIZE), (90, 90)])
def test_the_cap_follows_the_size_of_the_images(
    data: Path, monkeypatch: pytest.MonkeyPatch, given: int | None, wanted: float
) -> None:
    monkeypatch.setattr(density_module, "FEWEST", 1)
    trainer = Trainer(small_config(max_gaussians=given), load_scene(data))
    density = splatting(trainer).density
    assert isinstance(density, GradientStrategy)
    assert density.max_gaussians == round(wanted)


RESUMED: dict[str, tuple[dict[str, Any], tuple[int, ...]]] = {
    "white": ({"background": "white"}, (3, 11, 16)),  # in the static phase, between and after densifications
    "random": ({"background": "random"}, (3, 11, 16)),
    "unseen removed": (
        {"prune_unseen_passes": 0.05, "window_full_fraction": 0.0, "scene_half_size": 2.0, "max_gaussians": 80},
        (11, 16),
    ),
    "mlp on nodes": ({"model": MODELS["mlp on nodes"]}, (3, 13)),
    "mixed on nodes": ({"model": MODELS["mixed on nodes"], "batch_size": 2}, (8, 13)),
    "hash4d": ({"model": MODELS["hash4d"], "batch_size": 2, "threads": 2}, (13,)),
    "mixed on gaussians": ({"model": MODELS["mixed on gaussians"]}, (13,)),
    "mcmc": ({"density_strategy": "mcmc"}, (11,)),
    "restarted at motion": (
        {
            "model": MODELS["mixed on gaussians"],
            "restart_at_motion": True,
            "window_full_fraction": 0.0,
            "batch_size": 2,
        },
        (5, 6, 7, 13),
    ),
    "raw quaternions, absolute gradients, noise": (
        {
            "model": dataclasses.replace(MODELS["mlp"], quat_space="raw", scale_space="linear", embedding_dim=0),
            "absolute_gradients": True,
            "time_noise": 0.5,
            "window_full_fraction": 0.0,
        },
        (5, 8, 16),
    ),
    "default": (
        {
            "model": dataclasses.replace(MODELS["mixed on nodes"], eps2d=0.15),
            "batch_size": 2,
            "threads": 2,
            "half_resolution_fraction": 0.5,
            "static_window_fraction": 0.1,
            "init_min_views": 0.5,
            "alpha_weight": 0.2,
            "opacity_reg": 0.01,
            "mse_fraction": 0.8,
            "eps2d_init": 0.3,
            "ema_fraction": 0.1,
        },
        (5, 7, 9, 14),
    ),
}
"""Settings and steps to stop after."""


@pytest.mark.usefixtures("no_curve")
@pytest.mark.parametrize(("changes", "stops"), RESUMED.values(), ids=RESUMED)
def test_resuming_changes_no_bit(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, changes: dict[str, Any], stops: tuple[int, ...]
) -> None:
    """Stopped in the middle of a pass over the images."""
    monkeypatch.setattr(schedule_module, "HALVED_WIDTH", SIZE)
    config = small_config(**changes)
    fit(config, data, tmp_path / "whole")
    whole = state_of(tmp_path / "whole")
    assert len(whole["/system/model/gaussians.means"]) != config.density.init_num_pts, "density control took no part"
    for stop in stops:
        parts = tmp_path / f"stopped after {stop}"
        outcome = fit(config, data, parts, observer=StopAfter(stop))
        assert (outcome.status, outcome.step, outcome.metrics) == ("interrupted", stop, {})
        torch.manual_seed(stop)
        assert fit(config, data, parts, resume=True).status == "finished"
        assert_same_bits(whole, state_of(parts))
        lines = [[{**line, "seconds": 0} for line in read_metrics(run)] for run in (tmp_path / "whole", parts)]
        assert lines[0] == lines[1]


def test_each_image_has_random_numbers_of_its_own(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither threads nor a resumed run change them."""
    drawn: dict[int, set[float]] = {}
    original = GaussianSplatting.loss

    def loss(system: GaussianSplatting, frame: Frame, target: Target, background: Tensor, moment: Moment) -> ViewLoss:
        drawn.setdefault(moment.step, set()).add(float(torch.rand((), generator=moment.generator)))
        return original(system, frame, target, background, moment)

    monkeypatch.setattr(GaussianSplatting, "loss", loss)
    found = []
    for threads in (1, 2):
        trained(small_config(batch_size=2, threads=threads), load_scene(data), 4)
        found.append(drawn.copy())
        drawn.clear()
    trainer = trained(small_config(batch_size=2), load_scene(data), 2)
    trainer.save_checkpoint(tmp_path / "checkpoint.pt", 0.0)
    resumed = Trainer(trainer.config, trainer.scene)
    resumed.load_checkpoint(tmp_path / "checkpoint.pt")
    resumed.step()
    resumed.step()
    assert found[0] == found[1] == drawn
    assert len(set().union(*drawn.values())) == 2 * 4


def test_a_run_learns_and_leaves_everything(data: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    outcome = fit(small_config(steps=150, eval_every=50, checkpoint_every=50, reset_every_fraction=0.0), data, run)
    names = {str(p.relative_to(run)) for p in run.rglob("*") if p.is_file()}
    assert names == {
        "config.json", "run.json", "metrics.jsonl", "metrics.json", "curve.png", "checkpoint.pt", "model.pt", "best.pt",
        ".lock", "renders/test_r_000.png", "renders/test_r_001.png", "renders/val_r_000.png",
    }  # fmt: skip
    first, *_, last = [line for line in read_metrics(run) if line["kind"] == "eval" and line["split"] == "test"]
    assert last["psnr"] > first["psnr"] > 12
    assert outcome.metrics["test"].psnr == last["psnr"]
    final = json.loads((run / "metrics.json").read_text())
    assert final["splits"]["test"]["psnr"] == last["psnr"]
    evaluations = [line for line in read_metrics(run) if line["kind"] == "eval" and line["split"] == "test"]
    assert final["best_evaluations"]["test"]["psnr"] == max(line["psnr"] for line in evaluations)
    assert final["best_evaluations"].keys() == {"test", "val"}
    assert TrainConfig.from_dict(json.loads((run / "config.json").read_text())).run.steps == 150
    loaded = load_model(run / "model.pt")
    assert loaded.step == 150
    assert len(loaded.model.gaussians) == outcome.gaussians
    assert [camera["t"] for camera in loaded.scene.cameras] == [0.25, 0.75]
    kept = [camera["camera_to_world"] for camera in loaded.scene.training_cameras]
    assert kept == [frame.camera.camera_to_world.tolist() for frame in load_scene(data).splits["train"]]
    low, high = loaded.scene.bounds
    assert all(a < b for a, b in zip(low, high, strict=True))


@pytest.mark.usefixtures("no_curve")
def test_a_run_is_not_overwritten_and_keeps_its_settings(data: Path, tmp_path: Path) -> None:
    config, run = small_config(steps=2), tmp_path / "run"
    with pytest.raises(InvalidInput, match="to resume it"):
        fit(config, data, run, resume=True)
    fit(config, data, run)
    with pytest.raises(InvalidInput, match="--resume"):
        fit(config, data, run)
    with pytest.raises(InvalidInput, match=r"`config\.ssim_lambda`"):
        fit(small_config(steps=2, ssim_lambda=0.5), data, run, resume=True)
    assert fit(small_config(steps=3), data, run, resume=True).step == 3
    with pytest.raises(InvalidInput, match=r"`config\.steps` must be 3, or so near it that step 3 stays in its phase"):
        fit(small_config(steps=300), data, run, resume=True)


def test_a_run_is_saved_before_its_last_evaluation(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def evaluate(*_: object, **__: object) -> None:
        raise OSError("an image can't be read")

    monkeypatch.setattr("msdgs_train.engine.run.Run._evaluate", evaluate)
    with pytest.raises(OSError, match="an image"):
        fit(small_config(steps=2, llffhold=3, checkpoint_every=0, eval_every=0), data, tmp_path / "run")
    saved = load_model(tmp_path / "run" / "model.pt")
    assert (saved.step, saved.scene.llffhold) == (2, 3)


@pytest.mark.usefixtures("no_curve")
def test_a_run_is_evaluated_at_the_times_that_it_was_trained_with(data: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    fit(small_config(steps=2, time_from="none"), data, run)
    assert load_model(run / "model.pt").scene.time_from == "none"
    assert {frame.t for frame in evaluate_run(run, brief=True).frames} == {0.0}
    with pytest.raises(InvalidInput, match=r"`config\.time_from` must be none, as when the run was started, got names"):
        fit(small_config(steps=3, time_from="names"), data, run, resume=True)


def test_images_of_a_step_share_it_evenly(data: Path) -> None:
    config = small_config(static_fraction=0.0, window_full_fraction=0.0, refine_every_fraction=0.0)
    scene = load_scene(data)

    def gradients(batch_size: int, threads: int) -> list[list[Tensor]]:
        trainer = Trainer(config.updated(batch_size=batch_size, threads=threads), scene)
        found = []
        for _ in range(6 // batch_size):
            average_gradients(
                trainer.system.parameter_groups(), trainer._render_and_backward(trainer.system.parameter_groups())
            )
            grads = [p.grad for p in splatting(trainer).model.parameters() if p.grad is not None]
            assert all(grad.is_contiguous() for grad in grads), "fused Adam takes any gradient for a dense one"
            found.append([grad.clone() for grad in grads])
        return found

    one_by_one, at_once = gradients(1, 1), gradients(6, 3)[0]
    for single, together in zip(zip(*one_by_one, strict=True), at_once, strict=True):
        mean = torch.stack(single).double().mean(0)
        scale = float(torch.stack(single).abs().amax()) or 1.0
        assert float((together - mean).abs().max()) <= scale * tolerance("float32.relative")
    assert all(map(torch.equal, at_once, gradients(6, 2)[0])), "the same bits for any number of threads"


def test_a_gradient_is_the_mean_over_the_images_that_update_the_parameter(data: Path) -> None:
    trainer = Trainer(small_config(batch_size=2, window_full_fraction=0.0), load_scene(data))
    first, second = trainer._render_and_backward(trainer.system.parameter_groups())
    groups, means = trainer.system.parameter_groups(), splatting(trainer).model.gaussians.means
    average_gradients(groups, [first, second])
    assert means.grad is not None
    assert torch.equal(means.grad, (first.gradients[id(means)] + second.gradients[id(means)]) / 2)
    without = {key: gradient for key, gradient in second.gradients.items() if key != id(means)}
    average_gradients(groups, [first, second._replace(gradients=without)])
    assert torch.equal(means.grad, first.gradients[id(means)])


@pytest.mark.usefixtures("no_curve")
def test_a_checkpoint_without_one_of_its_values_is_refused(data: Path, tmp_path: Path) -> None:
    config, checkpoint = small_config(steps=2), tmp_path / "run" / "checkpoint.pt"
    fit(config, data, tmp_path / "run")
    state = torch.load(checkpoint, weights_only=True)
    for part in (state, state["system"]):
        for name in set(part) - {"average", "averages_weight"}:  # a longer run, and earlier versions, have none
            value = part.pop(name)
            torch.save(state, checkpoint)
            with pytest.raises(CheckpointInvalid, match=r"checkpoint\.pt: isn't (of format|a complete checkpoint)"):
                fit(config.updated(steps=4), data, tmp_path / "run", resume=True)
            part[name] = value
    del state["averages_weight"]
    torch.save(state, checkpoint)
    trainer = Trainer(config, load_scene(data))
    trainer.load_checkpoint(checkpoint)
    assert trainer.step_count == 2


@pytest.mark.parametrize(
    ("strategy", "step", "several_per_time", "pruning"),
    [
        ("gradient", 18, False, True), ("gradient", 19, True, False), ("gradient", 17, False, False),
        ("gradient", 17, True, True), ("mcmc", 19, False, True),
    ],
)  # fmt: skip
def test_weighted_regularizers_are_added_to_the_loss(
    data: Path, monkeypatch: pytest.MonkeyPatch, strategy: str, step: int, several_per_time: bool, pruning: bool
) -> None:
    """The time window is full from step 18 on, and density control ends with step 19."""
    plane = PlaneConfig(
        resolution=5, multires=(1, 2), time_smoothness_weight=1.0, l1_time_planes_weight=1e3, plane_tv_weight=10.0,
        plane_smoothness_weight=100.0,
    )  # fmt: skip
    density: dict[str, Any] = {"density_strategy": strategy, "opacity_reg": 2e4, "scale_reg": 3e5}
    model = dataclasses.replace(small_config().model, layers=(plane, MLP))
    scene = load_scene(data)
    if several_per_time:
        scene.splits["train"] *= 2
    system = splatting(Trainer(small_config(model=model, static_fraction=0.0, **density), scene))
    expected, layer = 0.0, system.model.deformation.layers[0]
    assert isinstance(layer, PlaneLayer)
    with torch.no_grad():
        for grid in layer.plane_grids():
            grid.time.add_(torch.randn(grid.time.shape, generator=torch.Generator().manual_seed(1)))
            expected += grid.time_smoothness() + 1e3 * grid.l1_time_planes()
            expected += 10 * grid.plane_tv() + 100 * grid.plane_smoothness()
        posed = system.model.pose(0.3, sh_degree=0)
        if pruning:
            expected += 2e4 * posed.opacities.double().mean() + 3e5 * posed.scales.double().mean()
        assert len(layer.plane_grids()) == 2
        frame = load_scene(data).splits["train"][0]
        target, black = Target(torch.zeros(SIZE, SIZE, 3), torch.zeros(SIZE, SIZE)), torch.zeros(3)
        monkeypatch.setattr(system_module, "photometric_loss", lambda *arguments: torch.zeros(()))
        loss = system.loss(dataclasses.replace(frame, t=0.3), target, black, Moment(step, torch.Generator())).loss
        assert float(loss) == pytest.approx(float(expected), rel=tolerance("float32.relative"))


def test_an_outlier_of_a_gradient_is_clipped(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(system_module, "photometric_loss", lambda rgb, target, *parts: 1e9 * (rgb - target).sum() ** 2)
    trainer = trained(small_config(steps=100, static_fraction=0.0), load_scene(data), 3)
    gradients = [p.grad for p in splatting(trainer).model.deformation.parameters() if p.grad is not None]
    assert torch.nn.utils.get_total_norm(gradients) == pytest.approx(trainer.config.optimizer.gradient_clip)


def test_learning_rates(data: Path) -> None:
    assert exponential(1.0, 0.01, 0, 100) == 1.0
    assert exponential(1.0, 0.01, 50, 100) == pytest.approx(0.1)
    assert exponential(1.0, 0.01, 200, 100) == pytest.approx(0.01)
    layers = (dataclasses.replace(MLP, lr_init=1.0, lr_final=1e-3), dataclasses.replace(MLP, lr_init=2.0), PLANE)
    model = ModelConfig(sh_degree=1, support=NodesConfig(num_nodes=4), layers=layers, embedding_dim=4)
    config = small_config(model=model)
    first, middle, last = (learning_rates(config, data, step) for step in (0, 18, 24))
    assert last["means"] == pytest.approx(8e-6)
    assert first["means"] == config.optimizer.means_lr_init > middle["means"] > last["means"]
    assert first["layers.0.network"] == middle["layers.0.network"] == 1.0, "held while the window grows, to step 18"
    assert last["layers.0.network"] == pytest.approx(1e-3)
    assert (middle["layers.1.network"], last["layers.1.network"]) == (2.0, pytest.approx(MLP.lr_final))
    grids = (PLANE.grid_lr_init, pytest.approx(PLANE.grid_lr_final))
    assert (middle["layers.2.grids"], last["layers.2.grids"]) == grids
    assert (middle["skinning_logits"], last["skinning_logits"]) == (2e-2, pytest.approx(2e-3))
    assert first["modulation"] == first["embeddings"] > middle["modulation"] > last["modulation"]
    for group in ("raw_opacities", "log_scales", "raw_quats", "sh_dc", "sh_rest"):
        assert first[group] == middle[group] == last[group]


def test_metrics_after_the_checkpoint_are_dropped(tmp_path: Path) -> None:
    lines = [json.dumps({"kind": "train", "step": step}) for step in (1, 2, 3)]
    (tmp_path / "metrics.jsonl").write_text("\n".join(lines) + '\n{"kind": "tr')
    MetricsLog(tmp_path, keep_until=2)
    assert [line["step"] for line in read_metrics(tmp_path)] == [1, 2]


def test_cameras_of_a_model_are_spread_and_kept_once(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scene_info, "VIEWER_CAMERAS", 2)
    monkeypatch.setattr(scene_info, "TRAINING_CAMERAS", 4)
    scene = load_scene(data)
    scene = dataclasses.replace(scene, splits={"train": scene.splits["train"]})
    Trainer(small_config(), scene).system.save(tmp_path / "model.pt", 0)
    info = load_model(tmp_path / "model.pt").scene
    poses = [frame.camera.camera_to_world.tolist() for frame in scene.splits["train"]]
    assert (len(info.cameras), len(info.training_cameras)) == (2, 2)
    found = [poses.index(entry["camera_to_world"]) for entry in [*info.cameras, *info.training_cameras]]
    assert len(set(found)) == 4

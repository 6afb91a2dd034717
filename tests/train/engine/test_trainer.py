"""A whole run on a tiny scene: it learns, it stops, and it goes on with the same bits."""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from msdgs_serve.scene import InvalidInput
from msdgs_serve.scene.spherical_harmonics import SH_C0
from msdgs_train.datasets import load_scene
from msdgs_train.engine import trainer as trainer_module
from msdgs_train.engine.config import TrainConfig
from msdgs_train.engine.curriculum import TrainingSample
from msdgs_train.engine.metrics_log import MetricsLog, read_metrics
from msdgs_train.engine.optimizer import exponential, learning_rates
from msdgs_train.engine.run import Observer, fit
from msdgs_train.engine.trainer import StepResult, Trainer, TrainingDiverged
from msdgs_train.gaussians.model import ModelConfig
from msdgs_train.gaussians.model_file import load_model
from tests.support.tolerances import tolerance
from tests.support.training_scene import (
    SHARED_MOTIONS,
    SIZE,
    StopAfter,
    assert_same_bits,
    small_config,
    state_of,
)

pytestmark = pytest.mark.slow


def _steps(trainer: Trainer, count: int) -> None:
    for _ in range(count):
        trainer.step()


@pytest.mark.parametrize("found", [20, 500])
def test_sparse_points_of_a_dataset_are_the_first_gaussians(data: Path, found: int) -> None:
    numbers = np.random.default_rng(0)
    points, colors = numbers.uniform(-0.5, 0.5, (found, 3)), numbers.uniform(0.1, 0.9, (found, 3))
    scene = dataclasses.replace(load_scene(data), points=points, point_colors=colors)
    trainer = Trainer(small_config(), scene)
    first, started = trainer.model.gaussians, min(found, trainer.config.init_num_pts)
    assert 20 < trainer.config.init_num_pts < 500
    assert len(first) == started
    nearest = np.linalg.norm(first.means.detach().numpy()[:, None] - points[None], axis=2).argmin(axis=1)
    assert len(set(nearest)) == started
    np.testing.assert_allclose(first.means.detach(), points[nearest], atol=1e-6)
    np.testing.assert_allclose(first.sh_dc.detach()[:, 0] * SH_C0 + 0.5, colors[nearest], atol=1e-6)
    _steps(trainer, 3)


RESUMED: dict[str, tuple[dict[str, Any], tuple[int, ...]]] = {
    "white": ({"background": "white"}, (3, 11, 16)),  # in the warm-up, between and after densifications
    "random": ({"background": "random"}, (3, 11, 16)),
    "motion bases": ({"model": SHARED_MOTIONS, "window_start_widths": (0.03, 0.2)}, (8, 13)),  # in each of two windows
    "mcmc": ({"density_strategy": "mcmc"}, (11,)),
}


@pytest.mark.usefixtures("no_curve")
@pytest.mark.parametrize(("case", "stop"), [(case, stop) for case, (_, stops) in RESUMED.items() for stop in stops])
def test_resuming_changes_no_bit(data: Path, tmp_path: Path, case: str, stop: int) -> None:
    """Stopped in the middle of a pass over the images."""
    config = small_config(**RESUMED[case][0])
    fit(config, data, tmp_path / "whole")
    outcome = fit(config, data, tmp_path / "parts", observer=StopAfter(stop))
    assert (outcome.status, outcome.step, outcome.qualities) == ("interrupted", stop, {})
    torch.manual_seed(stop)
    assert fit(config, data, tmp_path / "parts", resume=True).status == "finished"
    whole, parts = (state_of(tmp_path / name) for name in ("whole", "parts"))
    assert len(whole["/model/gaussians.means"]) != config.init_num_pts, "density control should have taken part"
    assert_same_bits(whole, parts)
    lines = [[{**line, "seconds": 0} for line in read_metrics(tmp_path / name)] for name in ("whole", "parts")]
    assert lines[0] == lines[1]


def test_a_run_learns_and_leaves_everything(data: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    outcome = fit(small_config(steps=150, eval_every=50, checkpoint_every=50, reset_every=0), data, run)
    names = {str(p.relative_to(run)) for p in run.rglob("*") if p.is_file()}
    assert names == {
        "config.json", "run.json", "metrics.jsonl", "metrics.json", "curve.png", "checkpoint.pt", "model.pt", "best.pt",
        "renders/test_r_000.png", "renders/test_r_001.png", "renders/val_r_000.png",
    }  # fmt: skip
    first, *_, last = [line for line in read_metrics(run) if line["kind"] == "eval" and line["split"] == "test"]
    assert last["psnr"] > first["psnr"] > 12
    assert outcome.qualities["test"].psnr == last["psnr"]
    assert json.loads((run / "metrics.json").read_text())["splits"]["test"]["psnr"] == last["psnr"]
    assert TrainConfig.from_dict(json.loads((run / "config.json").read_text())).steps == 150
    loaded = load_model(run / "model.pt")
    assert loaded.step == 150
    assert len(loaded.model.gaussians) == outcome.gaussians
    assert [camera["t"] for camera in loaded.scene.cameras] == [0.25, 0.75]
    low, high = loaded.scene.bounds
    assert all(a < b for a, b in zip(low, high, strict=True))


def test_saved_model_renders_as_evaluated(data: Path, tmp_path: Path) -> None:
    from msdgs_train.evaluation.metrics import quality

    trainer = Trainer(small_config(), load_scene(data))
    _steps(trainer, 24)
    trainer.save_model(tmp_path / "model.pt")
    model = load_model(tmp_path / "model.pt").model
    for evaluated in trainer.evaluate("test"):
        assert evaluated.rgb.shape == (SIZE, SIZE, 3)
        posed = model.pose(evaluated.frame.t)
        with torch.no_grad():
            rgb = trainer_module.rasterize(*posed, evaluated.frame.camera, torch.ones(3))[0]
        assert quality(rgb, evaluated.target) == evaluated.quality


@pytest.mark.usefixtures("no_curve")
def test_a_static_model_works_all_the_way(data: Path, tmp_path: Path) -> None:
    model = ModelConfig(sh_degree=0, layers=(), embedding_dim=0)
    assert fit(small_config(model=model), data, tmp_path / "run").status == "finished"


@pytest.mark.usefixtures("no_curve")
def test_time_budget_stops_evaluates_and_saves(data: Path, tmp_path: Path) -> None:
    outcome = fit(small_config(max_minutes=1e-9), data, tmp_path / "run")
    assert (outcome.status, outcome.step) == ("out of time", 1)
    assert set(outcome.qualities) == {"test", "val"}
    assert (tmp_path / "run" / "checkpoint.pt").exists()


@pytest.mark.usefixtures("no_curve")
def test_a_run_is_not_overwritten_and_keeps_its_settings(data: Path, tmp_path: Path) -> None:
    config, run = small_config(steps=2), tmp_path / "run"
    with pytest.raises(InvalidInput, match="with a checkpoint"):
        fit(config, data, run, resume=True)
    fit(config, data, run)
    with pytest.raises(InvalidInput, match="--resume"):
        fit(config, data, run)
    with pytest.raises(InvalidInput, match=r"`config\.l1_weight`"):
        fit(small_config(steps=2, l1_weight=0.5), data, run, resume=True)
    assert fit(small_config(steps=3), data, run, resume=True).step == 3


def test_a_loss_that_is_not_finite_is_skipped(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trainer = Trainer(small_config(steps=100, refine_every=0), load_scene(data))
    trainer.step()
    before = [p.detach().clone() for p in trainer.model.parameters()]
    monkeypatch.setattr(trainer_module, "photometric_loss", lambda rgb, target, *parts: rgb.sum() * float("nan"))
    result = trainer.step()
    assert (result.step, result.skipped) == (2, 1)
    assert all(torch.equal(a, b) for a, b in zip(before, trainer.model.parameters(), strict=True))
    with pytest.raises(TrainingDiverged, match="up to step 21"):
        _steps(trainer, 19)


def test_images_of_a_step_share_it_evenly(data: Path) -> None:
    config = small_config(static_fraction=0.0, window_full_fraction=0.0, refine_every=0, rigidity_weight=0.1)
    scene = load_scene(data)

    def gradients(batch_size: int, threads: int) -> list[list[Tensor]]:
        trainer = Trainer(dataclasses.replace(config, batch_size=batch_size, threads=threads), scene)
        found = []
        for _ in range(6 // batch_size):
            trainer._set_gradients(trainer._shots())
            found.append([p.grad.clone() for p in trainer.model.parameters() if p.grad is not None])
        return found

    one_by_one, at_once = gradients(1, 1), gradients(6, 3)[0]
    for single, together in zip(zip(*one_by_one, strict=True), at_once, strict=True):
        mean = torch.stack(single).double().mean(0)
        scale = float(torch.stack(single).abs().amax()) or 1.0
        assert float((together - mean).abs().max()) <= scale * tolerance("float32.relative")
    assert all(map(torch.equal, at_once, gradients(6, 2)[0])), "the same bits for any number of threads"


def test_a_parameter_learns_the_mean_of_the_images_that_teach_it(data: Path) -> None:
    trainer = Trainer(small_config(batch_size=2, window_full_fraction=0.0), load_scene(data))
    first, second = trainer._shots()
    of_first, of_second = first.gradients[0], second.gradients[0]
    assert of_first is not None
    assert of_second is not None
    means = trainer._parameters()[0]
    trainer._set_gradients([first, second])
    assert means.grad is not None
    assert torch.equal(means.grad, (of_first + of_second) / 2)
    trainer._set_gradients([first, second._replace(gradients=(None, *second.gradients[1:]))])
    assert torch.equal(means.grad, of_first)


class _Rollbacks(Observer):
    def __init__(self) -> None:
        self.seen: list[tuple[int, float]] = []
        self.steps: list[int] = []

    def step(self, result: StepResult, seconds: float) -> None:
        self.steps.append(result.step)

    def rolled_back(self, reason: str, step: int, lr_factor: float) -> None:
        assert "not finite" in reason
        self.seen.append((step, lr_factor))


def _break_losses(monkeypatch: pytest.MonkeyPatch, broken: range) -> None:
    """Not finite in those calls, counted over all trainers, and as they are in the others."""
    calls = iter(range(10**6))

    def breaking(whole: Callable[..., torch.Tensor]) -> Callable[..., torch.Tensor]:
        return lambda *arguments: whole(*arguments) * (float("nan") if next(calls) in broken else 1.0)

    for name in ("photometric_loss", "masked_l1"):
        monkeypatch.setattr(trainer_module, name, breaking(getattr(trainer_module, name)))


@pytest.mark.usefixtures("no_curve")
@pytest.mark.parametrize(("start", "back_to"), [(13, 10), (25, 20), (4, 0)])
def test_after_repeats_training_goes_back_to_the_last_good_checkpoint(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, start: int, back_to: int
) -> None:
    """Also where the next checkpoint would be due while steps are skipped: at 20 of the first case."""
    _break_losses(monkeypatch, range(start, start + 20))
    run, watched = tmp_path / "run", _Rollbacks()
    outcome = fit(small_config(steps=50, checkpoint_every=10, eval_every=0), data, run, observer=watched)
    assert (outcome.status, outcome.step) == ("finished", 50)
    assert watched.seen == [(back_to, 0.5)]
    assert watched.steps == [*range(1, start + 20), *range(back_to + 1, 51)]
    assert [line["step"] for line in read_metrics(run) if line["kind"] == "train"] == list(range(1, 51))
    last = [line for line in read_metrics(run) if line["kind"] == "train"][-1]
    assert (last["skipped"], last["step"]) == (20, 50)
    state = torch.load(run / "checkpoint.pt", weights_only=True)
    assert state["rollbacks"] == 1
    rates = {group["name"]: group["lr"] for group in state["optimizer"]["param_groups"]}
    assert rates["means"] == pytest.approx(0.5 * learning_rates(small_config(steps=50), 49)["means"])
    load_model(run / "model.pt")


@pytest.mark.usefixtures("no_curve")
def test_a_run_that_diverges_again_and_again_ends_with_its_last_good_checkpoint(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _break_losses(monkeypatch, range(15, 10**6))
    watched = _Rollbacks()
    config = small_config(steps=200, checkpoint_every=10, eval_every=0)
    with pytest.raises(TrainingDiverged, match=r"after 3 returns .* lower ones"):
        fit(config, data, tmp_path / "run", observer=watched)
    assert watched.seen == [(10, 0.5), (10, 0.25), (10, 0.125)]
    assert torch.load(tmp_path / "run" / "checkpoint.pt", weights_only=True)["step_count"] == 10
    load_model(tmp_path / "run" / "model.pt")


def test_another_way_is_taken_after_a_rollback(data: Path) -> None:
    diverged, again = (Trainer(small_config(window_full_fraction=0.0), load_scene(data)) for _ in range(2))
    first, second = ([_next_frame(trainer) for _ in range(7)] for trainer in (diverged, again))
    assert first == second
    again.retry_after(diverged)
    assert [_next_frame(again) for _ in range(7)] != first
    assert (again.rollbacks, again.lr_factor) == (1, 0.5)


def _next_frame(trainer: Trainer) -> str:
    return trainer._curriculum.next(trainer.step_count, trainer._generator).frame.name


def _plane_differences(planes: np.ndarray, order: int, axis: int) -> float:
    return float(np.mean(np.diff(planes, n=order, axis=axis) ** 2))


@pytest.mark.parametrize("mcmc", [False, True])
def test_what_is_added_to_the_loss(data: Path, mcmc: bool) -> None:
    model = dataclasses.replace(small_config().model, layers=("plane", "mlp"), multires=(1, 2), plane_resolution=5)
    weights = {"time_smoothness_weight": 1.0, "plane_tv_weight": 10.0, "plane_smoothness_weight": 100.0}
    config = small_config(
        model=model, static_fraction=0.0, density_strategy="mcmc" if mcmc else "gradient", opacity_reg=2e4,
        scale_reg=3e5, l1_time_planes_weight=1e3, **weights,
    )  # fmt: skip
    trainer = Trainer(config, load_scene(data))
    expected = 0.0
    with torch.no_grad():
        for grid in trainer.model.plane_grids():
            grid.time.add_(torch.randn(grid.time.shape, generator=torch.Generator().manual_seed(1)))
            space, time = grid.space.double().numpy(), grid.time.double().numpy()
            expected += _plane_differences(time, 2, 1) + 1e3 * np.abs(1 - time).mean()
            expected += sum(
                10 * _plane_differences(space, 1, a) + 100 * _plane_differences(space, 2, a) for a in (1, 2)
            )
        posed = trainer.model.pose(0.3)
        if mcmc:
            expected += 2e4 * posed.opacities.double().mean() + 3e5 * posed.scales.double().mean()
        assert len(trainer.model.plane_grids()) == 2
        lesson = TrainingSample(trainer.frames[0], 0.3, "everything")
        assert float(trainer._regularizers(posed, lesson, torch.Generator())) == pytest.approx(
            float(expected), rel=tolerance("float32.relative")
        )


def test_scales_that_come_out_at_nothing_are_counted(data: Path) -> None:
    model = dataclasses.replace(small_config().model, delta_space="activated")
    trainer = Trainer(small_config(model=model, static_fraction=0.0), load_scene(data))
    assert trainer.step().clamped_scales == 0
    with torch.no_grad():
        trainer.model.get_parameter("deformation.layers.0.heads.bias")[4] = -1e3
    result = trainer.step()
    assert result.clamped_scales == result.gaussians


def test_an_outlier_of_a_gradient_is_cut(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trainer = Trainer(small_config(steps=100, static_fraction=0.0), load_scene(data))
    monkeypatch.setattr(trainer_module, "photometric_loss", lambda rgb, target, *parts: 1e9 * (rgb - target).sum() ** 2)
    _steps(trainer, 3)
    gradients = [p.grad for p in trainer.model.deformation.parameters() if p.grad is not None]
    assert torch.nn.utils.get_total_norm(gradients) == pytest.approx(trainer_module.MAX_FIELD_GRADIENT)


def test_warmup_leaves_the_deformation_alone(data: Path) -> None:
    trainer = Trainer(small_config(static_fraction=0.25), load_scene(data))
    before = [p.detach().clone() for p in trainer.model.deformation.parameters()]
    _steps(trainer, 6)
    assert all(torch.equal(a, b) for a, b in zip(before, trainer.model.deformation.parameters(), strict=True))
    trainer.step()
    assert not all(torch.equal(a, b) for a, b in zip(before, trainer.model.deformation.parameters(), strict=True))


def test_learning_rates() -> None:
    assert exponential(1.0, 0.01, 0, 100) == 1.0
    assert exponential(1.0, 0.01, 50, 100) == pytest.approx(0.1)
    assert exponential(1.0, 0.01, 200, 100) == pytest.approx(0.01)
    config = TrainConfig()
    rates = learning_rates(config, config.steps)
    assert rates["means"] == pytest.approx(8e-6)
    assert rates["deformation"] == pytest.approx(config.deform_lr_final)
    assert rates["raw_opacities"] == 0.05
    while_the_window_grows = learning_rates(config, round(config.window_full_fraction * config.steps))
    assert while_the_window_grows["deformation"] == config.deform_lr_init
    assert while_the_window_grows["means"] < config.means_lr_init
    assert rates["means"] < while_the_window_grows["means"]
    first = learning_rates(config, 0)
    for group in ("raw_opacities", "log_scales", "raw_quats", "sh_dc", "sh_rest"):
        assert first[group] == while_the_window_grows[group] == rates[group]


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("steps", 0), ("l1_weight", 1.5), ("l1_weight", float("nan")), ("means_lr_init", 0.0),
        ("mse_fraction", 1.1), ("pooled_l1_weight", -1.0), ("ema_steps", -1),
        ("max_gaussians", 10), ("background", "green"), ("max_minutes", 0.0), ("refine_every", -1),
        ("quats_lr", float("inf")), ("size", 0), ("density_strategy", "none"), ("noise_lr", -1.0),
    ],
)  # fmt: skip
def test_settings_out_of_range_are_named(field: str, value: object) -> None:
    with pytest.raises(InvalidInput, match=f"`config.{field}`"):
        TrainConfig(**{field: value})  # type: ignore[arg-type]


def test_settings_survive_json_and_strangers_are_refused() -> None:
    config = small_config(background="random", size=SIZE)
    assert TrainConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config
    with pytest.raises(InvalidInput, match="`color`"):
        TrainConfig.from_dict({"color": 1})


def test_metrics_after_the_checkpoint_are_dropped(tmp_path: Path) -> None:
    lines = [json.dumps({"kind": "train", "step": step}) for step in (1, 2, 3)]
    (tmp_path / "metrics.jsonl").write_text("\n".join(lines) + '\n{"kind": "tr')
    MetricsLog(tmp_path, keep_until=2)
    assert [line["step"] for line in read_metrics(tmp_path)] == [1, 2]

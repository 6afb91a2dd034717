"""Losses and gradients that are not finite: steps are skipped, and a run returns to its last good checkpoint."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from msdgs_train.datasets import load_scene
from msdgs_train.engine.meters import TrainingDiverged
from msdgs_train.engine.metrics_log import read_metrics
from msdgs_train.engine.run import Observer, fit
from msdgs_train.engine.trainer import StepResult, Trainer
from msdgs_train.gaussians.model_file import load_model
from msdgs_train.systems import gaussian_splatting as system_module
from tests.support.training_scene import (
    StopAfter,
    learning_rates,
    small_config,
    splatting,
    trained,
)

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(
    "loss",
    [lambda rgb: rgb.sum() * float("nan"), lambda rgb: rgb.sum() + (rgb - rgb.detach()).sum().sqrt()],
    ids=["loss", "gradient"],
)
def test_a_loss_or_gradient_that_is_not_finite_is_skipped(
    data: Path, monkeypatch: pytest.MonkeyPatch, loss: Callable[[torch.Tensor], torch.Tensor]
) -> None:
    trainer = trained(small_config(steps=100, refine_every_fraction=0.0), load_scene(data), 1)
    before = [p.detach().clone() for p in splatting(trainer).model.parameters()]
    monkeypatch.setattr(system_module, "photometric_loss", lambda rgb, *others: loss(rgb))
    result = trainer.step()
    assert (result.step, result.skipped) == (2, 1)
    assert all(torch.equal(a, b) for a, b in zip(before, splatting(trainer).model.parameters(), strict=True))
    with pytest.raises(TrainingDiverged, match="up to step 21"):
        [trainer.step() for _ in range(19)]


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
    """Make losses of these calls, counted over all trainers, not finite."""
    calls = iter(range(10**6))

    whole = system_module.photometric_loss

    def breaking(*arguments: Any) -> torch.Tensor:
        return whole(*arguments) * (float("nan") if next(calls) in broken else 1.0)

    monkeypatch.setattr(system_module, "photometric_loss", breaking)


@pytest.mark.usefixtures("no_curve")
@pytest.mark.parametrize(("start", "back_to"), [(13, 10), (25, 20), (4, 0)])
def test_after_repeats_training_goes_back_to_the_last_good_checkpoint(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, start: int, back_to: int
) -> None:
    """Also if a checkpoint is due while steps are skipped: step 20 of the first case."""
    _break_losses(monkeypatch, range(start, start + 20))
    run, watched = tmp_path / "run", _Rollbacks()
    outcome = fit(small_config(steps=50, checkpoint_every=10, eval_every=0), data, run, observer=watched)
    assert (outcome.status, outcome.step) == ("finished", 50)
    assert watched.seen == [(back_to, 0.5)]
    assert watched.steps == [*range(1, start + 20), *range(back_to + 1, 51)]
    lines = [line for line in read_metrics(run) if line["kind"] == "train"]
    assert [line["step"] for line in lines] == list(range(1, 51))
    assert lines[-1]["skipped"] == 20
    state = torch.load(run / "checkpoint.pt", weights_only=True)
    assert state["rollbacks"] == 1
    rates = {group["name"]: group["lr"] for group in state["optimizer"]["param_groups"]}
    assert rates["means"] == pytest.approx(0.5 * learning_rates(small_config(steps=50), data, 49)["means"])
    load_model(run / "model.pt")


@pytest.mark.usefixtures("no_curve")
def test_an_interruption_while_steps_are_skipped_keeps_the_last_good_checkpoint(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _break_losses(monkeypatch, range(13, 25))
    config, run = small_config(steps=30, checkpoint_every=10, eval_every=0), tmp_path / "run"
    assert fit(config, data, run, observer=StopAfter(16)).status == "interrupted"
    assert torch.load(run / "checkpoint.pt", weights_only=True)["step_count"] == 10
    assert fit(config, data, run, resume=True).status == "finished"


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


def test_the_order_of_images_is_another_one_after_a_rollback(data: Path, tmp_path: Path) -> None:
    def next_frames(trainer: Trainer) -> list[str]:
        return [trainer._curriculum.next(0, 0, trainer._generator).name for _ in range(7)]

    trainer, other = (Trainer(small_config(window_full_fraction=0.0), load_scene(data)) for _ in range(2))
    first = next_frames(trainer)
    assert first == next_frames(other)
    trainer.roll_back(tmp_path / "no checkpoint yet")
    assert next_frames(trainer) != first
    assert (trainer.rollbacks, trainer.lr_factor) == (1, 0.5)

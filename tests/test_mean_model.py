"""The mean of the last steps: what it is the mean of, and that it is what is judged, shown, saved and resumed."""

from pathlib import Path

import numpy as np
import pytest
import torch

from msdgs_train import fit as fit_module
from msdgs_train.checkpoint import LoadedModel, load_model
from msdgs_train.datasets import load_scene
from msdgs_train.fit import Observer, fit
from msdgs_train.snapshot import snapshot_of_training
from msdgs_train.trainer import StepResult, Trainer
from tests.training_scene import SHARED_MOTIONS, small_config, write_scene

STEPS, BEGINS, KEPT = 24, 18, 3
CONFIG = small_config(
    model=SHARED_MOTIONS, window_until_fraction=0.5, densify_until_fraction=BEGINS / STEPS, average_steps=KEPT
)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scene(tmp_path_factory.mktemp("data") / "scene")


def _parameters(model: torch.nn.Module) -> list[np.ndarray]:
    return [p.detach().numpy().astype(np.float64) for p in model.parameters()]


def test_it_is_that_of_the_steps_after_density_control(data: Path) -> None:
    """All of them weigh the same until there are `average_steps`, then older ones ever less."""
    trainer, seen = Trainer(CONFIG, load_scene(data)), []
    for step in range(1, STEPS + 1):
        trainer.step()
        if step <= BEGINS:
            assert trainer.smoothed is trainer.model
            continue
        seen.append(_parameters(trainer.model))
        if len(seen) <= KEPT:
            expected = [np.mean(values, axis=0) for values in zip(*seen, strict=True)]
        else:
            expected = [(1 - 1 / KEPT) * old + last / KEPT for old, last in zip(expected, seen[-1], strict=True)]
        for mean, value in zip(_parameters(trainer.smoothed), expected, strict=True):
            np.testing.assert_allclose(mean, value, rtol=1e-5, atol=1e-6)
    moved = zip(_parameters(trainer.smoothed), seen[-1], strict=True)
    assert sum(not np.array_equal(mean, last) for mean, last in moved) > 5


def test_it_is_judged_shown_and_saved(data: Path, tmp_path: Path) -> None:
    trainer = Trainer(CONFIG, load_scene(data))
    for _ in range(STEPS):
        trainer.step()
    trainer.save_model(tmp_path / "model.pt")
    saved = load_model(tmp_path / "model.pt")
    last = LoadedModel(trainer.model, saved.scene, STEPS)
    for evaluated in trainer.evaluate("test"):
        view = (evaluated.frame.camera, evaluated.frame.t)
        np.testing.assert_array_equal(saved.render(*view).clamp(0, 1), evaluated.rgb)
        assert not torch.equal(last.render(*view), saved.render(*view))
        shown = snapshot_of_training(trainer).draw(*view, layers=1)
        np.testing.assert_allclose(shown / 255, evaluated.rgb, atol=1 / 255)


class _StopAfter(Observer):
    def __init__(self, step: int) -> None:
        self.last, self.limit = 0, step

    def step(self, result: StepResult, seconds: float) -> None:
        self.last = result.step

    def should_stop(self) -> bool:
        return self.last >= self.limit


@pytest.mark.parametrize("stop", [BEGINS, BEGINS + 1, BEGINS + 5])
def test_resuming_changes_no_bit_of_it(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stop: int) -> None:
    monkeypatch.setattr(fit_module, "draw_curve", lambda run: None)
    fit(CONFIG, data, tmp_path / "whole")
    fit(CONFIG, data, tmp_path / "parts", observer=_StopAfter(stop))
    fit(CONFIG, data, tmp_path / "parts", resume=True)
    whole, parts = (load_model(tmp_path / name / "model.pt").model.state_dict() for name in ("whole", "parts"))
    for name, value in whole.items():
        assert torch.equal(value, parts[name]), name


def test_more_steps_begin_it_anew(data: Path, tmp_path: Path) -> None:
    """Density control goes on then, and the Gaussians are other ones."""
    trainer = Trainer(CONFIG, load_scene(data))
    for _ in range(STEPS):
        trainer.step()
    trainer.save_checkpoint(tmp_path / "checkpoint.pt", 0.0)
    longer = Trainer(small_config(**{**CONFIG.to_dict(), "model": SHARED_MOTIONS, "steps": 2 * STEPS}), trainer.scene)
    longer.load_checkpoint(tmp_path / "checkpoint.pt")
    assert longer.smoothed is not longer.model
    longer.step()
    assert longer.smoothed is longer.model

"""The average of the last steps: its weights, and that it is evaluated, shown, saved and resumed."""

from pathlib import Path

import numpy as np
import pytest
import torch

from msdgs_train.datasets import load_scene
from msdgs_train.engine.config import TrainConfig
from msdgs_train.engine.metrics_log import to_bytes
from msdgs_train.engine.run import fit
from msdgs_train.engine.schedule import Schedule
from msdgs_train.engine.trainer import Trainer
from msdgs_train.gaussians.model_file import LoadedModel, load_model
from msdgs_train.viewer.snapshot import snapshot_of_training
from tests.support.training_scene import (
    SPLINES,
    StopAfter,
    assert_same_bits,
    small_config,
    splatting,
    state_of,
    trained,
)

pytestmark = pytest.mark.slow

STEPS, BEGINS, KEPT = 24, 18, 3
CONFIG = small_config(
    model=SPLINES,
    window_full_fraction=0.5,
    refine_stop_fraction=BEGINS / STEPS,
    ema_fraction=KEPT / STEPS,
    eval_every=0,
)
WINDOW_LAST = CONFIG.updated(
    batch_size=2, window_full_fraction=BEGINS / STEPS, refine_stop_fraction=0.5, eps2d_init=0.4
)


def _parameters(model: torch.nn.Module) -> list[np.ndarray]:
    return [p.detach().numpy().astype(np.float64) for p in model.parameters()]


def test_it_is_that_of_the_steps_after_density_control(data: Path) -> None:
    """Weights are equal for the first steps and decay exponentially after that."""
    trainer, seen = Trainer(CONFIG, load_scene(data)), []
    for step in range(1, STEPS + 1):
        trainer.step()
        if step <= BEGINS:
            assert splatting(trainer).eval_model is splatting(trainer).model
            continue
        seen.append(_parameters(splatting(trainer).model))
        if len(seen) <= KEPT:
            expected = [np.mean(values, axis=0) for values in zip(*seen, strict=True)]
        else:
            expected = [(1 - 1 / KEPT) * old + last / KEPT for old, last in zip(expected, seen[-1], strict=True)]
        for mean, value in zip(_parameters(splatting(trainer).eval_model), expected, strict=True):
            np.testing.assert_allclose(mean, value, rtol=1e-5, atol=1e-6)
    moved = zip(_parameters(splatting(trainer).eval_model), seen[-1], strict=True)
    assert sum(not np.array_equal(mean, last) for mean, last in moved) > 5


def test_it_is_evaluated_shown_and_saved(data: Path, tmp_path: Path) -> None:
    trainer = trained(CONFIG, load_scene(data), STEPS)
    trainer.system.save(tmp_path / "model.pt", STEPS)
    saved = load_model(tmp_path / "model.pt")
    last = LoadedModel(splatting(trainer).model, saved.scene, STEPS)
    for evaluated in trainer.evaluate("test"):
        view = (evaluated.frame.camera, evaluated.frame.t)
        np.testing.assert_array_equal(saved.render(*view).clamp(0, 1), evaluated.rgb)
        assert not torch.equal(last.render(*view), saved.render(*view))
        shown = snapshot_of_training(trainer).draw(*view, layers=1)
        np.testing.assert_array_equal(shown, to_bytes(evaluated.rgb.numpy()))


@pytest.mark.usefixtures("no_curve")
@pytest.mark.parametrize("config", [CONFIG, WINDOW_LAST], ids=["density control last", "window last"])
def test_resuming_changes_no_bit_of_it(data: Path, tmp_path: Path, config: TrainConfig) -> None:
    fit(config, data, tmp_path / "whole")
    kept = torch.load(tmp_path / "whole/checkpoint.pt", weights_only=True)["system"]["average"]["model"]
    for stop in (BEGINS, BEGINS + 1, BEGINS + 5):
        parts = tmp_path / f"stopped after {stop}"
        fit(config, data, parts, observer=StopAfter(stop))
        assert (state_of(parts)["/system/average/count"] if stop > BEGINS else 0) == min(stop - BEGINS, KEPT)
        fit(config, data, parts, resume=True)
        assert_same_bits(state_of(tmp_path / "whole"), state_of(parts))
        for file in ("model.pt", "best.pt"):
            saved = load_model(parts / file)
            assert saved.step == STEPS
            torch.testing.assert_close(saved.model.state_dict(), kept, rtol=0, atol=0)


def test_with_more_steps_it_begins_again(data: Path, tmp_path: Path) -> None:
    """Density control continues then, and changes the Gaussians."""
    trained(CONFIG, load_scene(data), STEPS).save_checkpoint(tmp_path / "checkpoint.pt", 0.0)
    longer = Trainer(CONFIG.updated(steps=2 * STEPS), load_scene(data))
    longer.load_checkpoint(tmp_path / "checkpoint.pt")
    assert splatting(longer).eval_model is splatting(longer).model
    longer.step()
    assert splatting(longer).eval_model is splatting(longer).model


def test_with_fewer_steps_it_is_of_those_that_were_done_since(data: Path, tmp_path: Path) -> None:
    trained(CONFIG, load_scene(data), 12).save_checkpoint(tmp_path / "checkpoint.pt", 0.0)
    shorter = Trainer(CONFIG.updated(steps=14), load_scene(data))
    shorter.load_checkpoint(tmp_path / "checkpoint.pt")
    seen = []
    for _ in range(2):
        shorter.step()
        seen.append(_parameters(splatting(shorter).model))
    for mean, *values in zip(_parameters(splatting(shorter).eval_model), *seen, strict=True):
        np.testing.assert_allclose(mean, np.mean(values, axis=0), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("last", ["static", "windows", "density control"])
def test_it_starts_after_density_control_and_the_time_window(last: str) -> None:
    ends = {"static": 0.25, "windows": 0.25, "density control": 0.25, last: 0.5}
    config = CONFIG.updated(
        static_fraction=ends["static"],
        window_full_fraction=ends["windows"],
        refine_stop_fraction=ends["density control"],
    )
    on, off = Schedule.from_config(config), Schedule.from_config(config.updated(ema_fraction=0.0))
    assert [step for step in range(1, STEPS + 1) if on.averages_at(step)] == list(range(13, STEPS + 1))
    assert not any(off.averages_at(step) for step in range(1, STEPS + 1))

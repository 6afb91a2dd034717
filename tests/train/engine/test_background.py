"""Training, evaluation, the model file and the live view have one color behind the scene."""

from pathlib import Path

import numpy as np
import pytest
import torch

from msdgs_train.datasets import Frame, load_scene
from msdgs_train.engine.trainer import Trainer
from msdgs_train.gaussians.stored import load_stored
from msdgs_train.systems.base import Moment, ViewLoss
from msdgs_train.systems.targets import Target
from msdgs_train.viewer.snapshot import snapshot_of_training
from tests.support.training_scene import small_config, splatting, write_scene

COLOR = (55 / 255, 0.0, 200 / 255)
CHANGED = np.array([200, 255, 55, 0], np.uint8)  # bits, which make white this color


@pytest.mark.parametrize(("background", "expected"), [("auto", COLOR), ("white", (1.0,) * 3), ("black", (0.0,) * 3)])
def test_all_have_the_color_behind_the_scene(
    tmp_path: Path, background: str, expected: tuple[float, float, float], monkeypatch: pytest.MonkeyPatch
):
    load, used = Frame.load_rgba, []
    monkeypatch.setattr(Frame, "load_rgba", lambda frame: load(frame) ^ CHANGED)
    trainer = Trainer(small_config(background=background), load_scene(write_scene(tmp_path)))
    system = splatting(trainer)
    of_frame, drawn = system.loss, system.render

    def loss(frame: Frame, target: Target, background: torch.Tensor, moment: Moment) -> ViewLoss:
        used.append(background)
        return of_frame(frame, target, background, moment)

    def render(camera, t, background, step):
        used.append(background)
        return drawn(camera, t, background, step)

    monkeypatch.setattr(system, "loss", loss)
    monkeypatch.setattr(system, "render", render)
    trainer.step()
    next(trainer.evaluate("test"))
    system.save(tmp_path / "model.pt", 1)
    assert [tuple(color.tolist()) for color in used] == [pytest.approx(expected)] * 2
    assert trainer.background == load_stored(tmp_path / "model.pt").scene.background == expected
    assert snapshot_of_training(trainer).background == expected

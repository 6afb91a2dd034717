"""`--tensorboard`: events equal `metrics.jsonl`, also after an interruption."""

import io
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from msdgs_train.cli import main as cli
from msdgs_train.engine.metrics_log import read_metrics
from msdgs_train.engine.run import RENDERS_PER_EVAL, Observer, fit
from msdgs_train.engine.tensorboard_events import EVAL_SCALARS, FOLDER, TRAIN_SCALARS
from msdgs_train.engine.trainer import StepResult
from tests.support.tolerances import tolerance
from tests.support.training_scene import FEW, SIZE, small_config, write_scene

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("no_curve")]

accumulator = pytest.importorskip(
    "tensorboard.backend.event_processing.event_accumulator",
    reason="tensorboard isn't installed: pip install 'msdgs[tensorboard]'",
)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scene(tmp_path_factory.mktemp("data") / "scene", test=RENDERS_PER_EVAL + 1)


def _events(run: Path) -> Any:
    """The run's events as TensorBoard reads them."""
    events = accumulator.EventAccumulator(str(run / FOLDER), size_guidance={"images": 0, "scalars": 0})
    return events.Reload()


def _assert_as_in_metrics(run: Path) -> None:
    expected: dict[str, list[tuple[int, float]]] = {}
    for line in read_metrics(run):
        group, names = ("train", TRAIN_SCALARS) if line["kind"] == "train" else (line["split"], EVAL_SCALARS)
        for name in names:
            expected.setdefault(f"{group}/{name}", []).append((line["step"], line[name]))
    events = _events(run)
    assert set(events.Tags()["scalars"]) == set(expected)
    for tag, points in expected.items():
        found = [(event.step, event.value) for event in events.Scalars(tag)]
        assert [step for step, _ in found] == [step for step, _ in points], tag
        np.testing.assert_allclose(
            [value for _, value in found], [value for _, value in points], rtol=tolerance("float32.relative")
        )


class _BreakAt(Observer):
    def __init__(self, step: int) -> None:
        self.at = step

    def step(self, result: StepResult, seconds: float) -> None:
        if result.step == self.at:
            raise RuntimeError("simulated power failure")


def test_a_run_that_broke_off_is_seen_once(data: Path, tmp_path: Path) -> None:
    """Steps 9 to 14 are after the last checkpoint and are trained and logged again."""
    run, config = tmp_path / "run", small_config(checkpoint_every=8)
    with pytest.raises(RuntimeError, match="power"):
        fit(config, data, run, observer=_BreakAt(14), tensorboard=True)
    assert [event.step for event in _events(run).Scalars("train/loss")][-1] == 14
    fit(config, data, run, resume=True, tensorboard=True)
    _assert_as_in_metrics(run)
    assert len(_events(run).Scalars("train/loss")) == config.run.steps


def test_turned_on_by_a_resumed_run_it_has_all_steps(data: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    fit(small_config(steps=12), data, run)
    assert not (run / FOLDER).exists()
    fit(small_config(steps=16), data, run, resume=True, tensorboard=True)
    _assert_as_in_metrics(run)


def test_held_out_renderings_at_every_evaluation(data: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    fit(small_config(), data, run, tensorboard=True)
    fit(small_config(), data, run, resume=True, tensorboard=True)  # finished: its last model is evaluated again
    _assert_as_in_metrics(run)
    events = _events(run)
    shown = {f"test/r_{i:03d}" for i in range(RENDERS_PER_EVAL)} | {"val/r_000"}
    assert set(events.Tags()["images"]) == shown
    images = events.Images("test/r_000")
    assert [image.step for image in images] == [10, 20, 24]
    pixels = np.asarray(Image.open(io.BytesIO(images[-1].encoded_image_string)))
    np.testing.assert_array_equal(pixels, np.asarray(Image.open(run / "renders" / "test_r_000.png")))
    assert pixels.shape == (SIZE, 2 * SIZE, 3)


def test_the_command_line_asks_for_it(data: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    assert cli.main(["fit", str(data), str(run), "--steps=2", *FEW, "--log-every=1", "--tensorboard"]) == 0
    _assert_as_in_metrics(run)
    assert math.isfinite(_events(run).Scalars("test/psnr")[0].value)

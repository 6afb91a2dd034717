"""Nothing of a run is lost: by another dataset, by a new run in its folder, by damaged files, or by a full disk."""

import contextlib
import hashlib
import json
import shutil
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.writing import WriteFailed
from msdgs_train.cli import main as cli
from msdgs_train.datasets import SceneData, load_scene
from msdgs_train.engine import run as run_module
from msdgs_train.engine.metrics_log import MetricsLog, draw_curve, read_metrics
from msdgs_train.engine.observer import Observer
from msdgs_train.engine.run import fit
from msdgs_train.engine.run_record import (
    BEST,
    CHECKPOINT,
    CONFIG,
    CURVE,
    KEPT,
    LOCK,
    METRICS,
    MODEL,
    RECORD,
    RENDERS,
    RunInvalid,
    read_config,
    read_record,
    require_no_run,
    stored_config,
    write_config,
)
from msdgs_train.engine.trainer import StepResult
from msdgs_train.gaussians.safe_load import CheckpointInvalid, load
from tests.support.file_sizes import largest_file
from tests.support.training_scene import FEW, small_config, state_of, write_scene

FOREIGN = (
    "Expecting",
    "Traceback",
    "Errno",
    "pickle",
    "codec",
    "torch.",
    "zip",
    "Unpickl",
    "inline_container",
    "line 1",
)
"""Words of libraries."""


@pytest.fixture(scope="module")
def finished(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of two steps; it is only read."""
    run = tmp_path_factory.mktemp("finished") / "run"
    fit(small_config(steps=2), data, run)
    return run


@pytest.fixture
def run(finished: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    return shutil.copytree(finished, tmp_path / "run")


def digests(folder: Path) -> dict[str, str]:
    return {
        str(file.relative_to(folder)): hashlib.sha256(file.read_bytes()).hexdigest()
        for file in folder.rglob("*")
        if file.is_file()
    }


def in_one_line(command: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """The message of a command that fails."""
    assert cli.main(command) == cli.EXIT_INVALID
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert not [word for word in FOREIGN if word in error], error
    return error


def test_another_dataset_is_refused_before_anything_is_written(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    before = digests(run)
    for name, counts in (("other", {"train": 6}), ("one", {"train": 1, "test": 0})):
        other = write_scene(tmp_path / name, **counts)
        error = in_one_line(["fit", str(other), str(run), "--resume", "--steps", "3"], capsys)
        assert f"`data` must be the dataset of the run in {run}" in error
        assert f"got {other}, which differs in number of images" in error
        assert "in a new folder" in error
        assert digests(run) == before


@pytest.mark.slow
@pytest.mark.usefixtures("no_curve")
def test_a_copy_of_its_dataset_and_runs_of_earlier_versions_are_resumed(data: Path, run: Path, tmp_path: Path):
    copy = shutil.copytree(data, tmp_path / "moved")
    assert fit(small_config(steps=3), copy, run, resume=True).step == 3
    record = read_record(run)
    assert record is not None
    assert (record.data, record.best is not None) == (copy, True)
    values = json.loads((run / RECORD).read_text())
    dataset = values.pop("dataset")
    (run / RECORD).write_text(json.dumps(values))
    (run / ".checkpoint.a1b2c3d4.pt").write_bytes(b"half a checkpoint, of a killed run")
    assert fit(small_config(steps=4), data, run, resume=True).step == 4
    assert json.loads((run / RECORD).read_text())["dataset"] == dataset
    assert not list(run.glob(".check*"))


def test_an_older_run_with_more_images_is_refused_by_its_checkpoint(run: Path, tmp_path: Path):
    (run / RECORD).unlink()
    state = torch.load(run / CHECKPOINT, weights_only=True)
    torch.save(state | {"curriculum": torch.tensor([5, 1])}, run / CHECKPOINT)  # the images that remain of a pass
    other = write_scene(tmp_path / "other", train=5)
    before = digests(run)
    with pytest.raises(CheckpointInvalid, match="of these settings and this dataset"):
        fit(small_config(steps=3), other, run, resume=True)
    assert digests(run) == before


@pytest.mark.parametrize("name", KEPT)
def test_any_file_of_a_run_guards_its_folder(data: Path, tmp_path: Path, name: str):
    run = tmp_path / "run"
    run.mkdir()
    (run / name).write_bytes(b"precious")
    with pytest.raises(InvalidInput, match=f"`run` must be a new folder, .*, which holds {name}: "):
        fit(small_config(steps=1), data, run)
    assert {file.name: file.read_bytes() for file in run.iterdir()} == {name: b"precious"}


def test_a_run_that_ended_while_the_dataset_was_loaded_is_not_overwritten(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    run = tmp_path / "run"

    def loaded(*given: Any) -> SceneData:
        run.mkdir()
        (run / MODEL).write_bytes(b"precious")
        return load_scene(*given)

    monkeypatch.setattr(run_module, "load_scene", loaded)
    with pytest.raises(InvalidInput, match=r"`run` must be a new folder, .*, which holds model\.pt"):
        fit(small_config(steps=1), data, run)
    assert {file.name: file.read_bytes() for file in run.iterdir()} == {LOCK: b"", MODEL: b"precious"}


def test_other_files_do_not(tmp_path: Path):
    require_no_run(tmp_path / "new")
    require_no_run(tmp_path)
    (tmp_path / "notes.txt").touch()
    (tmp_path / ".lock").touch()
    require_no_run(tmp_path)
    with pytest.raises(InvalidInput, match=r"notes\.txt, which is a file"):
        require_no_run(tmp_path / "notes.txt")


def test_a_finished_run_without_its_checkpoint_is_neither_overwritten_nor_resumed(
    data: Path, run: Path, capsys: pytest.CaptureFixture[str]
):
    (run / CHECKPOINT).unlink()
    before = digests(run)
    assert "which holds config.json, run.json, model.pt, best.pt" in in_one_line(["fit", str(data), str(run)], capsys)
    error = in_one_line(["fit", str(data), str(run), "--resume"], capsys)
    assert f"with its checkpoint.pt, to resume it, got {run}, which has none: model.pt is whole" in error
    assert digests(run) == before


@pytest.mark.slow
@pytest.mark.usefixtures("no_curve")
def test_a_run_that_was_killed_before_its_first_checkpoint_starts_again(data: Path, run: Path, tmp_path: Path):
    """Its best model so far is replaced by a better one only."""
    for name in (CHECKPOINT, MODEL, "metrics.json"):
        (run / name).unlink()
    record = json.loads((run / RECORD).read_text())
    record["best"]["psnr"] = 80.0
    (run / RECORD).write_text(json.dumps(record))
    best = (run / BEST).read_bytes()
    assert fit(small_config(steps=2), data, run, resume=True).status == "finished"
    assert (run / BEST).read_bytes() == best
    assert [line["step"] for line in read_metrics(run) if line["kind"] == "train"] == [1, 2]
    begun = tmp_path / "begun"
    begun.mkdir()
    write_config(begun, small_config(steps=2))
    assert fit(small_config(steps=2), data, begun, resume=True).status == "finished"


@pytest.mark.parametrize("name", [CONFIG, RECORD, CHECKPOINT])
@pytest.mark.parametrize(
    "damage",
    [
        lambda whole: whole[: len(whole) // 2], lambda whole: b"", lambda whole: b"\0" * len(whole),
        lambda whole: b"\xff\xfe" + whole, lambda whole: b"[1, 2]", lambda whole: b"null", lambda whole: b"[" * 100_000,
        lambda whole: b'{"data": 1, "best": [3], "run": {"steps": "many"}, "model": 5}',
    ],
)  # fmt: skip
def test_a_damaged_file_is_named_in_our_words(
    data: Path, run: Path, name: str, damage: Callable[[bytes], bytes], capsys: pytest.CaptureFixture[str]
):
    (run / name).write_bytes(damage((run / name).read_bytes()))
    before = digests(run)
    error = in_one_line(["fit", str(data), str(run), "--resume", "--steps", "3"], capsys)
    assert str(run / name) in error
    assert digests(run) == before


def test_checkpoints_of_other_programs_are_named(data: Path, run: Path, capsys: pytest.CaptureFixture[str]):
    command = ["fit", str(data), str(run), "--resume", "--steps", "3"]
    for contents in (torch.nn.Linear(2, 2).state_dict(), [1], torch.zeros(3)):
        torch.save(contents, run / CHECKPOINT)
        assert "checkpoint.pt: isn't of format msdgs-checkpoint" in in_one_line(command, capsys)
    torch.save(torch.nn.Linear(2, 2), run / CHECKPOINT)
    with pytest.raises(CheckpointInvalid, match=r"isn't a whole torch checkpoint of tensors and plain values alone$"):
        load(run / CHECKPOINT)


def test_settings_that_are_damaged_or_missing_are_named(run: Path):
    (run / CONFIG).write_text('{"run": {"steps": 0}}')
    with pytest.raises(
        RunInvalid, match=r"config\.json: isn't usable: `config.steps` must be .* Give the run's --plugin"
    ):
        read_config(run)
    (run / CONFIG).unlink()
    with pytest.raises(InvalidInput, match=r"which has no config\.json"):
        stored_config(run)
    with pytest.raises(RunInvalid, match=r"config\.json: there is no such file or folder; RUN must be"):
        read_config(run)


def test_lines_of_metrics_that_a_killed_process_has_left_are_dropped_alone(tmp_path: Path):
    lines = [json.dumps({"kind": "train", "step": step}) for step in range(4)]
    (tmp_path / METRICS).write_bytes(
        "\n".join([lines[0], lines[1][:9], lines[2], "\0" * 40]).encode() + b"\n\xff\xfe\n" + lines[3][:12].encode()
    )
    assert [line["step"] for line in read_metrics(tmp_path)] == [0, 2]
    MetricsLog(tmp_path, keep_until=2)
    assert (tmp_path / METRICS).read_text() == f"{lines[0]}\n{lines[2]}\n"


class FullAfter(Observer):
    """From a step on, files may have so many bytes only."""

    def __init__(self, step: int, size: int, limits: contextlib.ExitStack) -> None:
        self.at, self.size, self.limits = step, size, limits

    def step(self, result: StepResult, seconds: float) -> None:
        if result.step == self.at:
            self.limits.enter_context(largest_file(self.size))


@pytest.mark.slow
@pytest.mark.usefixtures("no_curve")
@pytest.mark.parametrize(
    ("file", "size", "settings"),
    [
        (METRICS, 200, {"eval_every": 0}), (CHECKPOINT, 9000, {"eval_every": 0}),
        (RENDERS, 300, {"eval_every": 6, "log_every": 100}), (BEST, 9000, {"eval_every": 6}),
    ],
)  # fmt: skip
def test_on_a_full_disk_the_last_checkpoint_stays_and_resuming_continues(
    data: Path, tmp_path: Path, file: str, size: int, settings: dict[str, int]
):
    config, run = small_config(steps=8, checkpoint_every=4, **settings), tmp_path / "run"
    with contextlib.ExitStack() as limits, pytest.raises(WriteFailed) as failed:
        fit(config, data, run, observer=FullAfter(5, size, limits))
    error = str(failed.value)
    assert error.startswith(f"{run / file}")
    assert ": can't be written: a file may not be as large there" in error
    assert error.endswith("Then --resume continues the run from its last checkpoint")
    assert state_of(run)["/step_count"] == 4
    assert fit(config, data, run, resume=True).status == "finished"
    assert not list(run.rglob(".msdgs-*"))


def test_fewer_steps_than_are_done_are_refused(run: Path, data: Path, capsys: pytest.CaptureFixture[str]):
    before = digests(run)
    error = in_one_line(["fit", str(data), str(run), "--resume", "--steps", "1"], capsys)
    assert "`config.steps` must be 2 or more, as so many steps are done" in error
    assert digests(run) == before


def test_a_run_below_a_file_has_nothing_to_resume(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "file").touch()
    error = in_one_line(["fit", str(data), str(tmp_path / "file" / "run"), "--steps", "2", *FEW], capsys)
    assert "a part of the path is a file" in error
    assert "--resume" not in error


@pytest.mark.slow
def test_a_disk_that_is_full_from_the_start_is_named(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    run, command = tmp_path / "run", ["fit", str(data), str(tmp_path / "run"), "--steps", "2", *FEW]
    with largest_file(100):
        error = in_one_line(command, capsys)
    assert error.startswith(f"error: {run / CONFIG}: can't be written: ")
    require_no_run(run)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")  # raised again by `flush`
def test_so_are_the_plot_and_the_events(tmp_path: Path):
    others = set(threading.enumerate())
    log, line = MetricsLog(tmp_path, tensorboard=True), StepResult(1, 0.5, 20.0, 100, 0)
    log.train(line, 1.0)
    with pytest.raises(WriteFailed, match=f"^{tmp_path / CURVE}: can't be written"), largest_file(1000):
        draw_curve(tmp_path)
    assert not (tmp_path / CURVE).exists()

    def write() -> None:
        with contextlib.closing(log):
            log.train(line, 2.0)
            log.flush()

    with pytest.raises(WriteFailed, match=f"^{tmp_path / 'tensorboard'}: can't be written"), largest_file(300):
        write()
    for thread in set(threading.enumerate()) - others:  # it ends with the error, which is ignored in this test alone
        thread.join()

"""`msdgs-train` as a program: help, errors, Ctrl-C and resuming."""

import errno
import json
import os
import signal
import sys
from pathlib import Path

import pytest
import torch

from msdgs_train.cli import fit_progress
from msdgs_train.cli import main as cli
from msdgs_train.cli.fit_progress import FitProgress
from msdgs_train.engine.run import fit
from msdgs_train.systems.registry import systems
from tests.support.models import random_model, saved
from tests.support.processes import program, wait_for
from tests.support.training_scene import FEW, small_config

pytestmark = pytest.mark.slow

SMALL = [
    *(*FEW, "--log-every=1", "--sh-degree=1", "--embedding-dim=4"),
    *("--layers", *["mlp:width=16,depth=2,time_width=8"] * 2),
]

STATIONARY = ["--static-fraction=0", "--window-full-fraction=0"]
"""Phases that don't move with the number of steps."""


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ("--help", "fit synthetic"),
        (
            "fit --help",
            "--resume --layers KIND[:NAME=VALUE,…] Ctrl-C --help-all --viewer while|it|trains msdgs[viewer]",
        ),
        ("fit --help-all", "--viewer-port --viewer-host msdgs[viewer]"),
        ("fit --help-all --preset deformgs", "default:|40000"),
        ("fit --help-all --preset msdgs-small", "default:|16000"),
        ("synthetic --help", "--train-frames motion"),
        ("view --help", "MODEL --port after|each|layer msdgs[viewer]"),
        ("eval --help", "RUN DATA --split LPIPS moving contact|sheet"),
        ("steps --help", "MODEL --t --out --size --camera layers nearest|in|time"),
        ("compare --help", "SYSTEM... DATA... --minutes|MINUTES mine.toml"),
    ],
)
def test_the_help_has_examples(command: str, words: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit_info:
        cli.main(command.split())
    assert exit_info.value.code == 0
    shown = " ".join(capsys.readouterr().out.split())
    for word in words.split():
        assert word.replace("|", " ") in shown
    assert not [word for word in ("None", "null", "factory", "(default: )") if word in shown]


def test_every_preset_has_settings_of_its_own_in_the_help(capsys: pytest.CaptureFixture[str]) -> None:
    shown = set()
    for name in systems():
        with pytest.raises(SystemExit):
            cli.main(["fit", "--preset", name, "--help-all"])
        shown.add(capsys.readouterr().out)
    assert len(shown) == len(systems())


@pytest.mark.parametrize(
    ("package", "command", "extra"),
    [
        ("viser", ["fit", "--viewer"], "viewer"),
        ("viser", ["view"], "viewer"),
        ("tensorboard", ["fit", "--tensorboard"], "tensorboard"),
    ],
)
def test_an_extra_that_is_missing_is_named_before_anything_is_done(
    package: str,
    command: list[str],
    extra: str,
    data: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.delitem(sys.modules, "torch.utils.tensorboard", raising=False)
    monkeypatch.setitem(sys.modules, package, None)
    paths = [data, tmp_path / "run"] if command[0] == "fit" else [saved(tmp_path, random_model())]
    assert cli.main([*command, *map(str, paths)]) == cli.EXIT_INVALID
    assert f"pip install 'msdgs[{extra}]'" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--steps 0", "`config.steps`"),
        ("--resume", "`run`"),
        ("--preset hexplane", "`preset`"),
        ("--preset static --resume", "`preset` must be not given"),
        ("--layers mlp hash", "mlp, plane, spline"),
        ("--layers mlp:hight=3", "`hight`"),
        ("--layers mlp:width=0", "model.layers.0.width"),
        ("--layers mlp:time_frequencies=0", "model.layers.0.time_frequencies"),
        ("--layers mlp mlp:lr_init=0", "model.layers.1.lr_init"),
        ("--layers plane:plane_tv_weight=-1.0", "model.layers.0.plane_tv_weight"),
        ("--support nodes:skinning_lr_final=-1.0", "model.support.skinning_lr_final"),
        ("--support gaussians --layers spline", "without --support nodes"),
        ("--support cage", "gaussians, nodes"),
        ("--preset deformgs-faithful --eps2d-init 0.9", "`config.eps2d_init`"),
        ("--preset deformgs-faithful --modulation-targets means", "embedding_dim is 0"),
        ("--preset sc-gs-small --window-start-width 0.1", "`config.window_start_width`"),
        ("--preset static --time-noise 0.5", "there are no layers"),
    ],
)
def test_wrong_input_is_one_line_and_code_2(
    options: str, message: str, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["fit", str(data), str(tmp_path / "run"), *options.split()]) == cli.EXIT_INVALID
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not (tmp_path / "run").exists()


def test_data_and_options_that_are_not_there_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["fit", str(tmp_path / "nowhere"), str(tmp_path / "run")]
    assert cli.main(command) == cli.EXIT_INVALID
    assert "does not exist" in capsys.readouterr().err.replace("\n", "")
    assert cli.main(["synthetic", "/dev/null/scene"]) == cli.EXIT_INVALID
    assert "error: /dev/null: there is a file of this name already" in capsys.readouterr().err
    with pytest.raises(SystemExit) as exit_info:
        cli.main([*command, "--no-such-option"])
    assert exit_info.value.code == cli.EXIT_INVALID
    assert "--no-such-option" in capsys.readouterr().err


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupted_and_resumed(data: Path, tmp_path: Path, number: signal.Signals) -> None:
    """Ctrl-C finishes the step, saves, and prints the command to resume, which uses the run's settings."""
    run = tmp_path / "run"
    log = run / "metrics.jsonl"
    with program("msdgs_train.cli.main", "fit", data, run, "--steps=100000", *STATIONARY, *SMALL) as process:
        wait_for(lambda: process.poll() is not None or (log.exists() and log.read_text().count("\n") >= 3), 300)
        process.send_signal(number)
        output = process.communicate(timeout=600)[0]
    assert process.returncode == cli.EXIT_INTERRUPTED, output
    assert "interrupted at step" in output
    assert f"msdgs-train fit {data} {run} --resume" in output
    step = torch.load(run / "checkpoint.pt", weights_only=True)["step_count"]
    assert 0 < step < 100000
    more = ["fit", str(data), str(run), "--resume", "--steps", str(step + 3)]
    assert cli.main(more) == 0
    assert json.loads((run / "metrics.json").read_text())["step"] == step + 3
    assert json.loads((run / "config.json").read_text())["density"]["init_num_pts"] == 60
    assert cli.main([*more, "--ssim-lambda", "0.1"]) == cli.EXIT_INVALID


class Unread:
    """An output that is not read, as of a pager that has ended."""

    encoding = "utf-8"

    def write(self, text: str) -> int:
        raise BrokenPipeError(errno.EPIPE, os.strerror(errno.EPIPE))

    def flush(self) -> None:
        raise BrokenPipeError(errno.EPIPE, os.strerror(errno.EPIPE))


def test_training_goes_on_if_its_output_is_not_read(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    progress = FitProgress(2)
    monkeypatch.setattr(fit_progress.console, "_file", Unread())  # `file` would keep this test's stdout afterwards
    monkeypatch.setattr(fit_progress.console, "on_broken_pipe", lambda: sys.exit(1))  # its own closes the real output
    with progress:
        config = small_config(steps=2)
        assert fit(config, data, tmp_path / "run", observer=progress).status == "finished"


def test_images_that_memory_has_no_room_for_are_named(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for number, (memory, is_named) in enumerate((("0", True), ("1", False))):
        run = ["fit", str(data), str(tmp_path / str(number)), "--steps=1", f"--image-memory={memory}", *SMALL]
        assert cli.main(run) == 0
        assert ("--image-memory 1 keeps all" in capsys.readouterr().out) == is_named


def test_synthetic_makes_what_fit_reads(tmp_path: Path) -> None:
    data = tmp_path / "toy"
    assert cli.main(["synthetic", str(data), "--size", "16", "--train-frames", "3", "--test-frames", "1"]) == 0
    assert cli.main(["fit", str(data), str(tmp_path / "run"), "--steps", "2", *SMALL]) == 0


def test_options_override_the_preset(data: Path, tmp_path: Path) -> None:
    assert cli.main(["fit", str(data), str(tmp_path / "run"), "--preset=static", "--steps=2", *FEW]) == 0
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    assert (config["model"]["layers"], config["density"]["init_num_pts"]) == ([], 60)
    assert (config["curriculum"]["window_full_fraction"], config["run"]["system"]) == (0.0, "static")


def test_layers_and_supports_are_parsed_from_text(data: Path, tmp_path: Path) -> None:
    options = ["--support", "nodes:num_nodes=5", "--layers", "spline:num_knots=6", "mlp:width=16,skip=1,depth=2"]
    assert cli.main(["fit", str(data), str(tmp_path / "run"), "--steps=2", *FEW, *options]) == 0
    model = json.loads((tmp_path / "run" / "config.json").read_text())["model"]
    assert (model["support"]["kind"], model["support"]["num_nodes"]) == ("nodes", 5)
    spline, mlp = model["layers"]
    assert (spline["kind"], spline["num_knots"], mlp["kind"], mlp["width"]) == ("spline", 6, "mlp", 16)

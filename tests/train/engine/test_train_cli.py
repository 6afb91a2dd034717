"""`msdgs-train` as a program: help, errors, Ctrl-C and going on."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from msdgs_train.cli import main as cli
from msdgs_train.systems.registry import systems
from tests.support.processes import ROOT

pytestmark = pytest.mark.slow

SMALL = [
    *("--threads=1", "--init-num-pts=60", "--max-gaussians=90", "--log-every=1", "--sh-degree=1", "--embedding-dim=4"),
    *("--layers", *["mlp:width=16,depth=2,time_width=8"] * 2),
]


@pytest.mark.parametrize("command", [[], ["fit"], ["synthetic"]])
def test_help(command: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit_info:
        cli.main([*command, "--help"])
    assert exit_info.value.code == 0
    text = capsys.readouterr().out
    expected = {
        "fit": ["--resume", "--layers", "KIND[:NAME=VALUE,…]", "Ctrl-C", "--help-all"],
        "synthetic": ["--train-frames", "motion"],
    }
    for word in expected[command[0]] if command else ["fit", "synthetic"]:
        assert word in text


def test_wrong_input_is_one_line_and_code_2(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cases = {
        "`config.steps`": ["fit", str(data), str(tmp_path / "run"), "--steps", "0"],
        "`run`": ["fit", str(data), str(tmp_path / "run"), "--resume"],
        "`preset`": ["fit", str(data), str(tmp_path / "run"), "--preset", "hexplane"],
        "`preset` must be not given": ["fit", str(data), str(tmp_path / "run"), "--preset", "static", "--resume"],
        "does not exist": ["fit", str(tmp_path / "nowhere"), str(tmp_path / "run")],
    }
    for word, arguments in cases.items():
        assert cli.main(arguments) == cli.EXIT_INVALID
        assert word in capsys.readouterr().err.replace("\n", "")
    assert not (tmp_path / "run").exists()


def test_interrupted_and_resumed(data: Path, tmp_path: Path) -> None:
    """Ctrl-C ends the step, saves, says how to go on; going on takes the settings from the run."""
    run = tmp_path / "run"
    command = [sys.executable, "-m", "msdgs_train.cli.main", "fit", str(data), str(run)]
    process = subprocess.Popen(
        [*command, "--steps", "100000", *SMALL], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=_env()
    )
    try:
        _wait_for_lines(run / "metrics.jsonl", process)
        process.send_signal(signal.SIGINT)
        output = process.communicate(timeout=600)[0]
    finally:
        process.kill()
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


def test_synthetic_makes_what_fit_reads(tmp_path: Path) -> None:
    data = tmp_path / "toy"
    assert cli.main(["synthetic", str(data), "--size", "16", "--train-frames", "3", "--test-frames", "1"]) == 0
    assert cli.main(["fit", str(data), str(tmp_path / "run"), "--steps", "2", *SMALL]) == 0


def _env() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(ROOT)}


def _wait_for_lines(path: Path, process: subprocess.Popen, lines: int = 3, seconds: float = 300) -> None:
    deadline = time.monotonic() + seconds
    while not (path.exists() and len(path.read_text().splitlines()) >= lines):
        assert process.poll() is None, process.communicate()[0]
        assert time.monotonic() < deadline, "no step in time"
        time.sleep(0.05)


def test_a_preset_gives_way_to_what_is_given_beside_it(data: Path, tmp_path: Path) -> None:
    options = ["--preset", "static", "--steps", "2", "--init-num-pts", "60", "--max-gaussians=90", "--threads=1"]
    assert cli.main(["fit", str(data), str(tmp_path / "run"), *options]) == 0
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    assert (config["model"]["layers"], config["density"]["init_num_pts"]) == ([], 60)
    assert (config["curriculum"]["window_full_fraction"], config["run"]["system"]) == (0.0, "static")


def test_help_shows_the_settings_of_a_preset(capsys: pytest.CaptureFixture[str]) -> None:
    shown = {}
    for name in systems():
        with pytest.raises(SystemExit):
            cli.main(["fit", "--preset", name, "--help-all"])
        shown[name] = " ".join(capsys.readouterr().out.split())
    assert "default: 40000" in shown["deformgs"]
    assert "default: 16000" in shown["msdgs-small"]
    assert len(set(shown.values())) == len(shown)


def test_parts_are_given_as_words(data: Path, tmp_path: Path) -> None:
    options = ["--support", "nodes:num_nodes=5", "--layers", "spline:num_knots=6", "mlp:width=16,skip=1,depth=2"]
    command = ["fit", str(data), str(tmp_path / "run"), "--steps", "2", "--init-num-pts=60", "--threads=1"]
    assert cli.main([*command, *options]) == 0
    model = json.loads((tmp_path / "run" / "config.json").read_text())["model"]
    assert (model["support"]["kind"], model["support"]["num_nodes"]) == ("nodes", 5)
    assert [(layer["kind"], layer.get("width"), layer.get("num_knots")) for layer in model["layers"]] == [
        ("spline", None, 6),
        ("mlp", 16, None),
    ]


@pytest.mark.parametrize(
    ("option", "message"),
    [
        (["--layers", "mlp", "hash"], "mlp, plane, spline"),
        (["--layers", "mlp:hight=3"], "`hight`"),
        (["--layers", "mlp:width=0"], "model.layers.0.width"),
        (["--support", "gaussians", "--layers", "spline"], "--model.support nodes"),
        (["--support", "cage"], "gaussians, nodes"),
    ],
)
def test_parts_that_cannot_be_used_are_named(
    option: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["fit", "data", str(tmp_path / "run"), *option]) == cli.EXIT_INVALID
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_an_option_that_is_not_known_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit_info:
        cli.main(["fit", "data", "run", "--no-such-option"])
    assert exit_info.value.code == cli.EXIT_INVALID
    assert "--no-such-option" in capsys.readouterr().err

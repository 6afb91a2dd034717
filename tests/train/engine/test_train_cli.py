"""`msdgs-train` as a program: help, errors, Ctrl-C and going on."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import get_args

import pytest
import torch

from msdgs_train.cli import main as cli
from tests.support.processes import ROOT

pytestmark = pytest.mark.slow

SMALL = [
    *("--threads=1", "--init-num-pts=60", "--max-gaussians=90", "--log-every=1", "--model.sh-degree=1"),
    *("--model.width=16", "--model.depth=2", "--model.time-width=8", "--model.embedding-dim=4"),
]


@pytest.mark.parametrize("command", [[], ["fit"], ["synthetic"]])
def test_help_teaches(command: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit_info:
        cli.main([*command, "--help"])
    assert exit_info.value.code == 0
    text = capsys.readouterr().out
    expected = {"fit": ["--resume", "--model.layers", "Ctrl-C"], "synthetic": ["--train-frames", "motion"]}
    for word in expected[command[0]] if command else ["fit", "synthetic"]:
        assert word in text


def test_wrong_input_is_one_line_and_code_2(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cases = {
        "`config.steps`": ["fit", str(data), str(tmp_path / "run"), "--steps", "0"],
        "`run`": ["fit", str(data), str(tmp_path / "run"), "--resume"],
        "`preset`": ["fit", str(data), str(tmp_path / "run"), "--preset", "hexplane"],
        "`preset` must be left out": ["fit", str(data), str(tmp_path / "run"), "--preset", "static", "--resume"],
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
    assert json.loads((run / "config.json").read_text())["init_num_pts"] == 60
    assert cli.main([*more, "--l1-weight", "0.1"]) == cli.EXIT_INVALID


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
    assert (config["model"]["layers"], config["init_num_pts"], config["window_full_fraction"]) == ([], 60, 0.0)


def test_help_shows_the_settings_of_a_preset(capsys: pytest.CaptureFixture[str]) -> None:
    shown = {}
    for name in get_args(cli.PresetName):
        with pytest.raises(SystemExit):
            cli.main(["fit", "--preset", name, "--help"])
        shown[name] = " ".join(capsys.readouterr().out.split())
    assert "default: 40000" in shown["deformgs"]
    assert "default: 16000" in shown["msdgs-small"]
    assert len(set(shown.values())) == len(shown)

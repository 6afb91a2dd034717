"""The start of every command: Ctrl-C while modules are imported, other signals, and warnings of libraries."""

import os
import signal
import subprocess
import sys
import tomllib
from importlib import import_module
from pathlib import Path

import pytest

from msdgs_serve.process import EXIT_INTERRUPTED, EXIT_INVALID, STOPPING, stopped_by
from tests.support.processes import ROOT, run_python

HANGING_IMPORT = """
import time
print("importing", flush=True)
try:
    time.sleep(3600)
except BaseException as error:
    raise ImportError("initialization failed") from error
"""
"""A module whose import hangs, and turns Ctrl-C into another error, as native code does."""

ENTRY = "import sys; from {module} import {name}; sys.exit({name}())"
SCRIPTS = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["scripts"]
COMMANDS = {
    **{name: ["-c", ENTRY.format(module=at.split(":")[0], name=at.split(":")[1])] for name, at in SCRIPTS.items()},
    "python -m msdgs_train": ["-m", "msdgs_train"],
    **{name: [str(ROOT / "export" / name)] for name in ("to_onnx.py", "convert.py", "stability.py")},
}


@pytest.mark.slow
def test_help_ends_without_warnings_of_libraries():
    shown = subprocess.run(
        [sys.executable, "-m", "msdgs_train", "fit", "--help"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert "--preset" in shown.stdout
    assert shown.stderr == ""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "arguments", "package"),
    [
        *((name, [], "numpy") for name in COMMANDS),
        ("msdgs-train", ["fit", "data", "run"], "torch"), ("msdgs-train", ["eval", "run"], "torch"),
        ("to_onnx.py", ["model.pt"], "torch"), ("convert.py", ["a.onnx", "a.ply"], "onnxruntime"),
        ("stability.py", ["model.pt"], "torch"), ("msdgs-serve", ["a.onnx"], "onnxruntime"),
        ("msdgs-render", ["a.onnx", "frames"], "OpenImageIO"),
    ],
)  # fmt: skip
def test_ctrl_c_during_imports_is_one_line(command: str, arguments: list[str], package: str, tmp_path: Path):
    (tmp_path / f"{package}.py").write_text(HANGING_IMPORT)
    path = os.pathsep.join([str(tmp_path), str(ROOT)])
    with subprocess.Popen(
        [sys.executable, *COMMANDS[command], *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": path},
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # jobs in the background ignore it
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "importing\n"
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    assert errors.splitlines()[-1] == "interrupted"
    assert "Traceback" not in errors
    assert process.returncode == EXIT_INTERRUPTED


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "arguments", "number"),
    [
        ("msdgs-serve", ["a.onnx"], "--port"), ("msdgs-render", ["a.onnx", "frames"], "--frames"),
        ("msdgs-train", ["synthetic", "out"], "--size"), ("python -m msdgs_train", ["fit", "data", "run"], "--steps"),
        ("to_onnx.py", ["model.pt"], "--times"), ("convert.py", ["a.onnx", "a.ply"], "--frames"),
        ("stability.py", ["model.pt"], "--times"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("is_known", [True, False])
def test_wrong_arguments_are_named_and_the_exit_status_is_the_same(
    command: str, arguments: list[str], number: str, is_known: bool, tmp_path: Path
):
    wrong = [number, "many"] if is_known else ["--surprise"]
    done = subprocess.run(
        [sys.executable, *COMMANDS[command], *arguments, *wrong],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == EXIT_INVALID, done.stderr
    assert wrong[0] in done.stdout + done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("name", SCRIPTS)
def test_the_installed_commands_exist(name: str):
    module, _, function = SCRIPTS[name].partition(":")
    assert callable(getattr(import_module(module), function))


@pytest.mark.parametrize("number", STOPPING)
def test_signals_that_stop_a_command_are_handled_in_a_block(number: signal.Signals):
    inherited = signal.signal(signal.SIGHUP, signal.SIG_DFL)  # nohup ignores it
    try:
        received, before = [], {each: signal.getsignal(each) for each in STOPPING}
        with stopped_by(lambda number, frame: received.append(number)):
            os.kill(os.getpid(), number)
        assert received == [number]
        assert {each: signal.getsignal(each) for each in STOPPING} == before
    finally:
        signal.signal(signal.SIGHUP, inherited)


def test_a_terminal_that_is_closed_is_ignored_if_it_was():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    received: list[int] = []
    try:
        with stopped_by(lambda number, frame: received.append(number)):
            os.kill(os.getpid(), signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, before)
    assert not received


WARNING = "from msdgs_serve.process import begin; begin(); import numpy; numpy.float32(1e38) * numpy.float32(10)"


def test_warnings_of_libraries_are_not_printed_unless_python_is_asked():
    merged = "import os; os.dup2(1, 2); "
    assert run_python(merged + WARNING) == ""
    assert "overflow encountered" in run_python(merged + WARNING, PYTHONWARNINGS="default")


def test_a_thread_that_fails_is_reported_unless_its_error_is_raised_again():
    code = """
import os, threading
os.dup2(1, 2)
from msdgs_serve.process import begin
begin()
def fail(error): raise error
for error in (OSError(28, "No space left on device"), ValueError("of a thread")):
    thread = threading.Thread(target=fail, args=(error,))
    thread.start()
    thread.join()
"""
    output = run_python(code)
    assert "ValueError: of a thread" in output
    assert "No space left" not in output

"""`pip install .` alone suffices to serve a scene outside of the checkout, and installs nothing for training; with the
other packages it also trains and exports."""

import json
import os
import shutil
import subprocess
import sysconfig
import venv
from pathlib import Path

import numpy as np
import pytest

from examples.serving import get, render, serving
from msdgs_serve.process import EXIT_INVALID
from tests.support.images import decode
from tests.support.processes import ROOT

PACKAGES = {"msdgs_export", "msdgs_serve", "msdgs_train"}
SCENE = ROOT / "examples" / "toys.onnx"

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("packaging")]  # one worker, so that pip runs once

DESCRIBE = """
import importlib.metadata as m, importlib.util, json
files = [str(path) for path in m.files("msdgs")]
names = sorted(d.name.lower() for d in m.distributions())
print(json.dumps({"files": files, "distributions": names, "where": importlib.util.find_spec("msdgs_serve").origin}))
"""


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A fresh environment with only the package of this checkout and its dependencies."""
    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder, with_pip=True)
    pins = str(ROOT / "constraints.txt")
    installed = subprocess.run(
        [folder / "bin" / "python", "-m", "pip", "install", "--no-compile", "--constraint", pins, str(ROOT)],
        cwd=folder,
        env=clean_environment(),
        capture_output=True,
        text=True,
        check=False,
    )
    if "No matching distribution" in installed.stderr and "connection broken" in installed.stderr:
        pytest.skip(f"no package index can be reached: {installed.stderr.strip().splitlines()[-1]}")
    assert installed.returncode == 0, installed.stdout + installed.stderr
    (site,) = folder.glob("lib/python*/site-packages")
    for compiled in ROOT.glob("msdgs_*/**/__pycache__/*.nb[ic]"):  # another test compiles them from nothing
        copy = site / compiled.relative_to(ROOT)
        copy.parent.mkdir(exist_ok=True)
        shutil.copy(compiled, copy)
    return folder


@pytest.fixture(scope="module")
def described(environment: Path) -> dict:
    """The installed files and distributions."""
    command = [environment / "bin" / "python", "-c", DESCRIBE]
    return json.loads(subprocess.check_output(command, cwd=environment, env=clean_environment()))


def clean_environment() -> dict[str, str]:
    """Environment variables without those that point to the checkout or to this environment."""
    return {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "VIRTUAL_ENV"))}


def test_the_package_is_installed_and_nothing_of_training(environment: Path, described: dict) -> None:
    assert Path(described["where"]).is_relative_to(environment)
    assert not {"torch", "onnx", "tyro", "rich", "matplotlib", "pytest", "zstandard"} & set(described["distributions"])


def test_the_wheel_holds_the_packages_and_their_data(described: dict) -> None:
    shipped = [path for path in described["files"] if not path.startswith(("..", "msdgs-"))]
    assert {path.split("/")[0] for path in shipped} == PACKAGES
    sources = [path for package in PACKAGES for path in (ROOT / package).rglob("*") if path.is_file()]
    wanted = {str(path.relative_to(ROOT)) for path in sources if path.parent.name != "__pycache__"}
    assert wanted <= set(shipped)
    assert "msdgs_serve/py.typed" in shipped


@pytest.mark.parametrize(
    "command", [["msdgs-train", "--help"], ["msdgs-export"], ["python", str(ROOT / "export" / "to_onnx.py")]]
)
def test_training_and_export_name_the_extra_that_they_need(environment: Path, command: list[str]) -> None:
    program = [environment / "bin" / command[0], *command[1:]]
    told = subprocess.run(
        program, cwd=environment, env=clean_environment(), capture_output=True, text=True, check=False
    )
    assert told.returncode == EXIT_INVALID
    assert "pip install" in told.stderr
    assert "Traceback" not in told.stderr


def test_it_serves_a_scene(environment: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    for name in set(os.environ) - set(clean_environment()):
        monkeypatch.delenv(name)
    with serving(SCENE, 0, environment) as url:
        scene = get(f"{url}/scenes/toys")
        camera = {"type": "orbit", "azimuth": 30, "elevation": 25}
        png = render(url, {"camera": camera, "t": sum(scene["time_range"]) / 2, "width": 48, "height": 32})
    pixels, _ = decode(png, "png")
    assert pixels.shape == (32, 48, 3)
    assert len(np.unique(pixels.reshape(-1, 3), axis=0)) > 100, "an empty frame"


def test_it_trains_exports_and_converts(environment: Path, tmp_path: Path) -> None:
    """The wheel's code, with the packages of the extras from the environment of the tests."""

    def run(*command: str) -> None:
        program, extras = environment / "bin" / command[0], {"PYTHONPATH": sysconfig.get_path("purelib")}
        done = subprocess.run(
            [program, *command[1:]],
            cwd=tmp_path,
            env=clean_environment() | extras,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stdout + done.stderr

    run("python", "-c", f"import msdgs_export as m; assert m.__file__.startswith({str(environment)!r})")
    run("msdgs-train", "synthetic", "data", "--size", "16", "--train-frames", "4", "--test-frames", "2")
    run("msdgs-train", "fit", "data", "run", "--steps", "5", "--init-num-pts", "100")
    run("msdgs-export", "run/model.pt", "--quick", "--times", "2", "--output", "scene.onnx")
    run("msdgs-convert", "scene.onnx", "scene.ply")
    run("msdgs-render", "scene.onnx", "frames", "--frames", "2", "--width", "24", "--height", "16")
    frames = [decode(file.read_bytes(), "png")[0] for file in sorted((tmp_path / "frames").glob("*.png"))]
    assert [frame.shape for frame in frames] == [(16, 24, 3)] * 2
    assert (tmp_path / "scene.ply").stat().st_size > 1000


def test_the_examples_take_at_most_two_megabytes():
    assert sum(file.stat().st_size for file in (ROOT / "examples").iterdir() if file.is_file()) <= 2.1e6

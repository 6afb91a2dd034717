"""A layer kind and a system from outside the package train, resume, are evaluated, compared, exported and served."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from msdgs_serve.deformation import DeformationSession
from msdgs_serve.renderer import Renderer
from msdgs_train.evaluation.layer_strip import camera_of
from msdgs_train.gaussians.model_file import load_model
from tests.support import plugin_example
from tests.support.images import decode
from tests.support.processes import ROOT, bodies, chromium, image, run_python, wait_until_still
from tests.support.service import serving
from tests.support.tolerances import assert_close, tolerance
from tests.support.training_scene import assert_same_bits, state_of

PLUGIN = Path(plugin_example.__file__)
SMALL = ["--steps=24", "--threads=1", "--init-num-pts=60", "--max-gaussians=90", "--eval-every=0", "--sh-degree=1"]
SMALL += ["--static-fraction=0.2", "--refine-start-fraction=0.17", "--refine-every-fraction=0.17"]

STOP_AFTER_A_STEP = """
import sys
from unittest.mock import patch
from msdgs_train.cli import fit_progress, main
with patch.object(fit_progress.FitProgress, "should_stop", lambda progress: True):
    assert main.main(sys.argv[1:]) == main.EXIT_INTERRUPTED
"""

pytestmark = pytest.mark.slow


def run(module: str, *arguments: object, code: int = 0) -> str:
    """The output of a command in a subprocess with only the given plugins."""
    environment = {name: value for name, value in os.environ.items() if name != "MSDGS_PLUGINS"}
    done = subprocess.run(
        [sys.executable, "-m", module, *map(str, arguments)],
        cwd=ROOT,
        env=environment | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == code, done.stdout + done.stderr
    return done.stdout + done.stderr


def train(*arguments: object, code: int = 0) -> str:
    return run("msdgs_train", *arguments, "--plugin", PLUGIN, code=code)


@pytest.fixture(scope="module")
def trained(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run."""
    folder = tmp_path_factory.mktemp("plugin") / "whole"
    train("fit", data, folder, "--preset", "sparse-fourier", *SMALL)
    return folder


def test_a_stopped_run_resumes_with_the_same_bits(data: Path, trained: Path, tmp_path: Path) -> None:
    stopped = tmp_path / "stopped"
    arguments = ["fit", data, stopped, "--preset", "sparse-fourier", *SMALL]
    run_python(STOP_AFTER_A_STEP, *arguments, MSDGS_PLUGINS=str(PLUGIN))
    assert "resumed after step 1" in train("fit", data, stopped, "--resume")
    assert_same_bits(state_of(stopped), state_of(trained))
    config = json.loads((trained / "config.json").read_text())
    assert [layer["kind"] for layer in config["model"]["layers"]] == ["fourier", "fourier"]
    moved = state_of(trained)["/system/model/deformation.layers.1.offsets"]
    assert bool(moved.any()), "the layer learns"


def test_it_is_evaluated_and_compared_in_worker_processes(data: Path, trained: Path, tmp_path: Path) -> None:
    train("eval", trained)
    report = json.loads((trained / "eval" / "test.json").read_text())
    assert report["models"]["last"]["mean"]["psnr"] > 5
    options = ["--seeds", 0, "--steps", 6, "--init-num-pts", 60, "--max-gaussians", 90, "--jobs", 1]
    train("compare", "sparse-fourier", "--data", data, "--out", tmp_path / "out", *options)
    (compared,) = json.loads((tmp_path / "out" / "comparison.json").read_text())["runs"]
    assert compared["system"] == "sparse-fourier"
    assert compared["deformation_parameters"] > 0


def test_its_layers_stand_beside_others_on_the_command_line(data: Path, tmp_path: Path) -> None:
    layers = ["--support", "nodes:num_nodes=5", "--layers", "spline", "fourier:frequencies=2", "mlp:width=8"]
    train("fit", data, tmp_path / "run", *SMALL, "--steps=3", *layers)
    stored = json.loads((tmp_path / "run" / "config.json").read_text())["model"]["layers"]
    assert [layer["kind"] for layer in stored] == ["spline", "fourier", "mlp"]


def test_without_the_plugin_the_missing_part_is_named(data: Path, trained: Path, tmp_path: Path) -> None:
    fit = ["fit", data, tmp_path / "run"]
    assert "--plugin MODULE, got sparse-fourier" in run("msdgs_train", *fit, "--preset", "sparse-fourier", code=2)
    assert "--plugin MODULE, got fourier" in run("msdgs_train", *fit, "--layers", "fourier", code=2)
    assert "--plugin MODULE, got fourier" in run("msdgs_train", "eval", trained, code=2)
    missing = run("msdgs_train", *fit, "--plugin", tmp_path / "none.py", code=2)
    assert "`plugin` must be a module that can be imported, or a Python file" in missing
    shutil.copyfile(PLUGIN, tmp_path / "random.py")
    same_name = run("msdgs_train", *fit, "--plugin", tmp_path / "random.py", code=2)
    assert "`plugin` must be a file of another name: there is a module `random`" in same_name


@pytest.fixture(scope="module")
def exported(trained: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The scene file of the run."""
    scene = tmp_path_factory.mktemp("scene") / "plugin.onnx"
    code = "import sys; from tests.support.models import *; export_scene(*map(Path, sys.argv[1:]), times=5)"
    run_python(code, trained / "model.pt", scene, MSDGS_PLUGINS=str(PLUGIN))
    return scene


def test_it_is_exported_and_served(trained: Path, exported: Path) -> None:
    """The scene file needs neither the plugin nor torch, and holds the poses of the model."""
    loaded, session = load_model(trained / "model.pt"), DeformationSession(exported)
    drawn = session.gaussians(0.37)
    with torch.no_grad():
        posed = loaded.model.pose(0.37)
    for field in ("means", "quats", "scales"):
        want = getattr(posed, field).numpy()
        np.testing.assert_allclose(getattr(drawn, field), want, rtol=0, atol=tolerance("export.relative"))
    entry = loaded.scene.cameras[0]
    image = Renderer().render(session, camera_of(entry, entry["width"]), 0.37)
    want = loaded.render(camera_of(entry, entry["width"]), 0.37).clamp(0, 1)
    assert_close(image.rgb, want.numpy(), "served_frame")


def test_the_page_shows_it(trained: Path, exported: Path) -> None:
    """The page's image from a camera of the scene equals those of the service and of the model."""
    with serving(exported) as client, chromium() as browser, browser.new_page() as page:
        asked = bodies(page)
        page.goto(f"{client.base_url}/#scene=plugin&t=0.37&camera=0")
        wait_until_still(page)
        shown, frame = image(page), client.post("/render", json=asked[-1])
    assert (asked[-1]["t"], asked[-1]["camera"]) == (0.37, {"type": "scene", "index": 0})
    np.testing.assert_array_equal(shown, decode(frame.content, "png")[0])
    assert len(np.unique(shown.reshape(-1, 3), axis=0)) > 50, "blank"
    loaded = load_model(trained / "model.pt")
    want = loaded.render(camera_of(loaded.scene.cameras[0], shown.shape[1]), 0.37).clamp(0, 1)
    assert want.shape == shown.shape
    assert_close(shown, 255 * want.numpy(), "served_frame.8bit")


def test_the_documented_code_is_the_example() -> None:
    """All code in the order layer, export, system; the other tests of this file run it."""
    page = (ROOT / "docs" / "extending.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```python\n(.*?)\n```", page, re.DOTALL)
    layer, export, system = blocks
    imports, code = PLUGIN.read_text(encoding="utf-8").split("\n\n\n", maxsplit=1)
    assert "import" in imports
    assert f"{layer}\n\n\n{system}\n\n{export}\n" == code

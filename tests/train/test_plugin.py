"""A layer kind and a system from outside the package train, resume, are evaluated, compared, exported and served."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from msdgs_serve.deformation import DeformationSession
from msdgs_serve.renderer import Renderer
from msdgs_train.cli import main as cli
from msdgs_train.cli.fit_progress import FitProgress
from msdgs_train.evaluation.layer_strip import camera_of
from msdgs_train.gaussians.model_file import load_model
from msdgs_train.layers.registry import LAYERS
from msdgs_train.systems import registry
from tests.support import plugin_example
from tests.support.images import decode
from tests.support.processes import ROOT, bodies, chromium, image, program, run_python, wait_until_still
from tests.support.service import serving
from tests.support.tolerances import assert_close, tolerance
from tests.support.training_scene import assert_same_bits, state_of

PLUGIN = Path(plugin_example.__file__)
SMALL = ["--steps=24", "--threads=1", "--init-num-pts=60", "--max-gaussians=90", "--eval-every=0", "--sh-degree=1"]
SMALL += ["--static-fraction=0.2", "--refine-start-fraction=0.17", "--refine-every-fraction=0.17"]

pytestmark = pytest.mark.slow


def train(*arguments: object) -> int:
    """Run a command in this process, which has imported the plugin."""
    return cli.main(list(map(str, arguments)))


def train_with_plugin(*arguments: object) -> None:
    """Run a command in another process, which knows the plugin from `--plugin` alone."""
    with program("msdgs_train", *arguments, "--plugin", PLUGIN) as process:
        output = process.communicate(timeout=600)[0]
    assert process.returncode == 0, output


@pytest.fixture(scope="module")
def trained(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run."""
    folder = tmp_path_factory.mktemp("plugin") / "whole"
    train_with_plugin("fit", data, folder, "--preset", "sparse-fourier", *SMALL)
    return folder


def test_a_stopped_run_resumes_with_the_same_bits(
    data: Path, trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    stopped = tmp_path / "stopped"
    with monkeypatch.context() as patch:
        patch.setattr(FitProgress, "should_stop", lambda progress: True)
        assert train("fit", data, stopped, "--preset", "sparse-fourier", *SMALL) == cli.EXIT_INTERRUPTED
    assert train("fit", data, stopped, "--resume") == 0
    assert "resumed after step 1" in capsys.readouterr().out
    assert_same_bits(state_of(stopped), state_of(trained))
    config = json.loads((trained / "config.json").read_text())
    assert [layer["kind"] for layer in config["model"]["layers"]] == ["fourier", "fourier"]
    moved = state_of(trained)["/system/model/deformation.layers.1.offsets"]
    assert bool(moved.any()), "the layer learns"


def test_it_is_evaluated_and_compared_in_worker_processes(data: Path, trained: Path, tmp_path: Path) -> None:
    assert train("eval", trained) == 0
    report = json.loads((trained / "eval" / "test.json").read_text())
    assert report["models"]["last"]["mean"]["psnr"] > 5
    options = ["--seeds", 0, "--steps", 6, "--init-num-pts", 60, "--max-gaussians", 90, "--jobs", 1]
    train_with_plugin("compare", "sparse-fourier", "--data", data, "--out", tmp_path / "out", *options)
    (compared,) = json.loads((tmp_path / "out" / "comparison.json").read_text())["runs"]
    assert compared["system"] == "sparse-fourier"
    assert compared["deformation_parameters"] > 0


def test_its_layers_stand_beside_others_on_the_command_line(data: Path, tmp_path: Path) -> None:
    layers = ["--support", "nodes:num_nodes=5", "--layers", "spline", "fourier:frequencies=2", "mlp:width=8"]
    assert train("fit", data, tmp_path / "run", *SMALL, "--steps=3", *layers) == 0
    stored = json.loads((tmp_path / "run" / "config.json").read_text())["model"]["layers"]
    assert [layer["kind"] for layer in stored] == ["spline", "fourier", "mlp"]


def test_its_support_is_trained_and_refuses_sizes(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = [*SMALL, "--steps=8", "--layers", "fourier", "mlp:width=8", "--support"]
    assert train("fit", data, tmp_path / "run", *options, "confined:radius=0") == cli.EXIT_INVALID
    assert "`model.support.radius` must be above 0" in capsys.readouterr().err
    assert train("fit", data, tmp_path / "run", *options, "confined:radius=0.6") == 0
    assert train("eval", tmp_path / "run") == 0
    model = load_model(tmp_path / "run" / "model.pt").model
    with torch.no_grad():
        for parameter in model.deformation.parameters():
            parameter.add_(0.1)
        inside = model.gaussians.means.norm(dim=1) < 0.6
        moved = (model.pose(0.37).means != model.gaussians.means).any(dim=1)
    assert inside.any()
    assert not inside.all()
    assert torch.equal(moved, inside)


def test_without_the_plugin_the_missing_part_is_named(
    data: Path, trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delitem(registry._ENTRIES, "sparse-fourier")
    monkeypatch.delitem(LAYERS, "fourier")
    fit = ["fit", data, tmp_path / "run"]
    shutil.copyfile(PLUGIN, tmp_path / "random.py")
    for command, message in (
        ([*fit, "--preset", "sparse-fourier"], "--plugin MODULE, got sparse-fourier"),
        ([*fit, "--layers", "fourier"], "--plugin MODULE, got fourier"),
        (["eval", trained], "--plugin MODULE, got fourier"),
        ([*fit, "--plugin", tmp_path / "none.py"], "`plugin` must be a module that can be imported, or a Python file"),
        (
            [*fit, "--plugin", tmp_path / "random.py"],
            "`plugin` must be a file of another name: there is a module `random`",
        ),
    ):
        assert train(*command) == cli.EXIT_INVALID
        assert message in capsys.readouterr().err


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
    """All code; the other tests of this file run it."""
    page = (ROOT / "docs" / "extending.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```python\n(.*?)\n```", page, re.DOTALL)
    *parts, export = blocks
    imports, code = PLUGIN.read_text(encoding="utf-8").split("\n\n\n", maxsplit=1)
    assert "import" in imports
    assert "\n\n\n".join(parts) + f"\n\n{export}\n" == code

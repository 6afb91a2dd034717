"""`msdgs-train steps`: an image after each layer."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from msdgs_serve.rasterizer import rasterize
from msdgs_serve.scene import Gaussians, InvalidInput
from msdgs_serve.scene.metadata import SceneCamera
from msdgs_train.cli import main as cli
from msdgs_train.engine.metrics_log import to_bytes
from msdgs_train.evaluation.layer_strip import write_steps
from msdgs_train.evaluation.sheets import Panel, draw_sheet, panel_corners, sheet_size
from msdgs_train.gaussians.model_file import CheckpointInvalid, save_model
from tests.support.models import CAMERA, SCENE, random_model

pytestmark = pytest.mark.slow

WIDTH, HEIGHT = 320, 240


@pytest.fixture
def model(tmp_path: Path) -> Path:
    save_model(tmp_path / "model.pt", random_model(noise=0.2), SCENE, 7)
    return tmp_path / "model.pt"


def _render(t: float, num_layers: int | None) -> np.ndarray:
    posed = random_model(noise=0.2).pose(t, num_layers=num_layers)
    gaussians = Gaussians(*(tensor.detach().numpy() for tensor in posed))
    nearest = min(SCENE.cameras, key=lambda camera: abs(camera["t"] - t))
    camera = SceneCamera.from_plain(nearest).camera.resized(WIDTH, HEIGHT)
    return to_bytes(rasterize(gaussians, camera, background=(1.0, 1.0, 1.0)).rgb)


def test_one_panel_a_layer_and_the_canonical_one_first(model: Path, tmp_path: Path) -> None:
    out = tmp_path / "made" / "steps.png"
    assert cli.main(["steps", str(model), "--t", "0.9", "--out", str(out), "--size", str(WIDTH)]) == 0
    sheet = np.asarray(oiio.ImageBuf(str(out)).get_pixels(oiio.UINT8))[..., :3]
    expected = [_render(0.9, 0), _render(0.9, 1), _render(0.9, None)]
    rows = [[Panel(pixels, "") for pixels in expected]]
    assert sheet.shape[1::-1] == sheet_size(rows)
    for (x, y), pixels in zip(panel_corners(rows)[0], expected, strict=True):
        np.testing.assert_array_equal(sheet[y : y + HEIGHT, x : x + WIDTH], pixels)
    assert not np.array_equal(expected[0], expected[1])
    assert not np.array_equal(expected[1], expected[2])
    assert [path.name for path in out.parent.iterdir()] == ["steps.png"]


@pytest.mark.parametrize("layers", [(), ("mlp", "plane", "mlp")])
def test_as_many_images_as_layers_and_one(layers: tuple[str, ...], tmp_path: Path) -> None:
    save_model(tmp_path / "model.pt", random_model(20, layers=layers), SCENE, 7)
    assert len(write_steps(tmp_path / "model.pt", tmp_path / "steps.png", size=30)) == len(layers) + 1


def test_time_and_camera_unless_given(tmp_path: Path) -> None:
    """0.3 of the way through the scene, from the camera whose image is nearest in time."""
    near = {**CAMERA, "name": "near", "t": 0.33, "cx": 10.0}
    scene = replace(SCENE, time_range=(0.2, 0.7), cameras=[{**CAMERA, "name": "far", "t": 0.1}, near])
    save_model(tmp_path / "model.pt", random_model(noise=0.2), scene, 7)
    default = write_steps(tmp_path / "model.pt", tmp_path / "a.png", size=64)
    given = write_steps(tmp_path / "model.pt", tmp_path / "b.png", size=64, t=0.35, camera="near")
    other = write_steps(tmp_path / "model.pt", tmp_path / "b.png", size=64, t=0.35, camera="far")
    np.testing.assert_array_equal(default, given)
    assert not np.array_equal(default, other)


@pytest.mark.parametrize(
    ("wrong", "word"),
    [
        ({"t": 1.5}, r"time range, \[0, 1\]"),
        ({"t": float("nan")}, "time range"),
        ({"camera": "missing"}, "r_000, r_001"),
        ({"size": 0}, "`size`"),
        ({"size": 40_000}, "width"),
        ({"out": Path("steps.jpeg")}, "`out`"),
    ],
)
def test_invalid_values_are_named(wrong: dict, word: str, model: Path, tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match=word):
        write_steps(model, **{"out": tmp_path / "steps.png", **wrong})
    assert not list(tmp_path.glob("*.png"))


def test_a_sheet_that_no_image_can_hold_is_refused(tmp_path: Path) -> None:
    row = [Panel(np.zeros((1, 22_000, 3), np.uint8), "")] * 3
    with pytest.raises(InvalidInput, match="65,535 pixels a side"):
        draw_sheet(tmp_path / "sheet.png", "", [row])


def test_a_missing_or_broken_model_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["steps", str(tmp_path / "none.pt")]) == cli.EXIT_INVALID
    assert "none.pt: no such file" in capsys.readouterr().err
    (tmp_path / "broken.pt").write_text("no")
    with pytest.raises(CheckpointInvalid):
        write_steps(tmp_path / "broken.pt", tmp_path / "steps.png")

"""Training, evaluation, export and service all render with the model's own eps2d."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from onnx import helper

from msdgs_export.measure.frames import render
from msdgs_export.measure.poses import in_float64, posed
from msdgs_export.measure.rendered_error import ExactFrames
from msdgs_export.measure.views import View
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.rasterizer import GSPLAT, as_trained, rasterize
from msdgs_serve.renderer import Renderer
from msdgs_serve.scene import Camera
from msdgs_train.datasets import Frame, load_scene
from msdgs_train.engine.metrics_log import to_bytes
from msdgs_train.engine.trainer import Trainer
from msdgs_train.evaluation.evaluate import EvaluatedModel
from msdgs_train.evaluation.layer_strip import camera_of, render_steps
from msdgs_train.gaussians.model_file import LoadedModel, load_model
from msdgs_train.viewer.snapshot import Snapshot
from tests.support.exports import parts_of
from tests.support.models import CAMERA, SCENE, export_scene, random_model, saved
from tests.support.tolerances import tolerance
from tests.support.training_scene import SPLINES, small_config, write_scene

pytestmark = pytest.mark.slow

T = 0.5
EPS2D = 0.02
NARROW = GSPLAT._replace(eps2d=EPS2D)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("narrow")
    model = random_model(count=60, eps2d=EPS2D)
    with torch.no_grad():
        model.gaussians.log_scales.sub_(1.5)  # below a pixel, where eps2d dominates
        model.gaussians.raw_opacities.add_(2.0)
    export_scene(saved(folder, model), folder / "scene.onnx")
    return folder


@pytest.fixture
def loaded(folder: Path) -> LoadedModel:
    return load_model(folder / "model.pt")


@pytest.fixture
def camera() -> Camera:
    return camera_of(CAMERA, CAMERA["width"])


@pytest.fixture
def expected(loaded: LoadedModel, camera: Camera) -> np.ndarray:
    gaussians = posed(loaded.model, T)
    narrow = render(gaussians, camera, SCENE.background, NARROW)
    assert np.abs(narrow - render(gaussians, camera, SCENE.background, GSPLAT)).max() > 0.05
    return narrow


def test_images_of_a_model(loaded: LoadedModel, camera: Camera, expected: np.ndarray):
    frame = Frame("a", camera, T, Path("a.png"))
    evaluated = EvaluatedModel("last", loaded, []).render(frame).numpy()
    np.testing.assert_allclose(evaluated, expected, atol=tolerance("served_frame"))
    np.testing.assert_array_equal(render_steps(loaded, T, camera)[-1], to_bytes(evaluated))
    snapshot = Snapshot(loaded.model, loaded.scene.background)
    np.testing.assert_array_equal(snapshot.draw(camera, T, layers=2), to_bytes(evaluated))


def test_a_served_frame(folder: Path, camera: Camera, expected: np.ndarray):
    session = DeformationSession(folder / "scene.onnx")
    assert session.scene.metadata.eps2d == EPS2D
    np.testing.assert_allclose(
        Renderer().render(session, camera, T).rgb.clip(0, 1), expected, atol=tolerance("served_frame")
    )


def test_exact_frames_of_an_export(
    folder: Path, tmp_path: Path, loaded: LoadedModel, camera: Camera, expected: np.ndarray
):
    model = loaded.model
    rows = np.arange(len(model.gaussians))
    exact = ExactFrames(in_float64(model), [View(camera, T, "a")], SCENE.background, model.rasterizer)
    assert exact.measure(exact.pose, rows).psnr_worst == 100.0
    exact.options = GSPLAT
    assert exact.measure(exact.pose, rows).psnr_worst < 40.0
    parts = parts_of(folder / "model.pt", tmp_path)
    candidate = parts.builder.candidate("network", 50.0)
    assert parts.ruler.exact.options == as_trained(candidate.session.scene.metadata) == NARROW
    assert parts.ruler.error(candidate).psnr_worst > 50.0
    got = candidate.session.gaussians(T)
    drawn = rasterize(got, camera, background=SCENE.background, options=NARROW).rgb.clip(0, 1)
    assert np.square(drawn - expected).mean() < 1e-5


def test_a_file_without_eps2d_has_the_default(folder: Path, tmp_path: Path):
    contents = onnx.load(folder / "scene.onnx")
    kept = {entry.key: entry.value for entry in contents.metadata_props if entry.key != "eps2d"}
    del contents.metadata_props[:]
    helper.set_model_props(contents, kept)
    onnx.save(contents, tmp_path / "scene.onnx")
    assert DeformationSession(tmp_path / "scene.onnx").scene.metadata.eps2d == GSPLAT.eps2d


def test_training_may_start_with_a_larger_eps2d(tmp_path: Path):
    """Saved models have the eps2d of their training step, also after a checkpoint is loaded."""
    sizes = replace(SPLINES, eps2d=EPS2D)
    config = small_config(model=sizes, window_full_fraction=0.5, eps2d_init=0.4)
    trainer = Trainer(config, load_scene(write_scene(tmp_path / "data")))

    def saved() -> float:
        trainer.system.save(tmp_path / "model.pt", trainer.step_count)
        return load_model(tmp_path / "model.pt").model.config.eps2d

    assert saved() == 0.4
    seen = []
    for _ in range(14):
        trainer.step()
        seen.append(saved())
        if trainer.step_count == 12:
            trainer.save_checkpoint(tmp_path / "checkpoint.pt", 0.0)
    assert seen == [0.4] * 12 + [EPS2D] * 2
    trainer.load_checkpoint(tmp_path / "checkpoint.pt")
    assert saved() == 0.4

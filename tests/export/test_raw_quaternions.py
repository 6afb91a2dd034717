"""A model whose quaternions keep their length: the file has unit ones and scales that draw the same."""

from pathlib import Path

import numpy as np
import pytest
import torch

from msdgs_export.bake import bake
from msdgs_export.plans.registry import build
from msdgs_export.trajectories.poses import QUATS, SCALES, ExactPoses
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.rasterizer import rasterize
from msdgs_train.gaussians.model_file import load_model
from msdgs_train.layers.base import LayerConfig
from tests.support.models import SCENE, export_scene, random_model, saved
from tests.support.scenes import front_camera
from tests.support.tolerances import tolerance
from tests.support.training_scene import MLP, PLANE

SWITCHES = {"scale_space": "linear", "quat_space": "raw", "embedding_dim": 0}


@pytest.mark.parametrize("layers", [(MLP, MLP), (PLANE,)], ids=["mlp", "plane"])
def test_frames_of_the_file_are_those_of_the_model(tmp_path: Path, layers: tuple[LayerConfig, ...]) -> None:
    """Training draws quaternions as they are; the service unit ones."""
    model = random_model(120, noise=0.1, layers=layers, **SWITCHES)
    exported = tmp_path / "scene.onnx"
    export_scene(saved(tmp_path, model), exported, times=4)
    session, loaded = DeformationSession(exported), load_model(tmp_path / "model.pt")
    assert loaded.model.config.quat_space == "raw"
    for t in (0.0, 0.37, 1.0):
        with torch.no_grad():
            ours = loaded.render(front_camera(), t).numpy()
        raw = loaded.model.pose(t)
        norms = torch.linalg.vector_norm(raw.quats.detach(), dim=1)
        assert float((norms - 1).abs().max()) > 0.05
        served = session.gaussians(t)
        assert float(np.abs(np.linalg.norm(served.quats, axis=1) - 1).max()) <= tolerance("float32.relative")
        frame = rasterize(served, front_camera(), background=SCENE.background, options=loaded.model.rasterizer).rgb
        assert float(ours.std()) > 0.01
        assert float(np.abs(frame - ours).max()) <= tolerance("served_frame")


def test_plans_that_sample_poses_read_the_unit_form() -> None:
    model = random_model(30, noise=0.1, layers=(MLP,), **SWITCHES)
    baked = bake(model, SCENE, "0" * 64)
    poses = ExactPoses(baked).at(0.37)
    with torch.no_grad():
        expected = model.double().pose(float(np.float32(0.37)))
    assert float(np.abs(poses[:, SCALES] - expected.scales.numpy()).max()) <= tolerance("first_order")
    same = np.abs((poses[:, QUATS] * expected.quats.numpy()).sum(axis=1))
    assert float(np.abs(same - 1).max()) <= tolerance("first_order")
    assert build("network", baked).graph.output[1].name == "quats"


def test_axes_of_equal_length_have_no_direction(tmp_path: Path) -> None:
    """Rotations of the file differ from the model's, shapes don't."""
    model = random_model(300, 1, noise=0.0, layers=(MLP,), **SWITCHES)
    with torch.no_grad():
        model.get_parameter("deformation.layers.0.heads.bias").copy_(torch.linspace(-0.1, 0.1, 11))
        model.gaussians.raw_quats.normal_(generator=torch.Generator().manual_seed(2))
        model.get_parameter("gaussians.log_scales").add_(
            1e-4 * torch.randn(300, 3, generator=torch.Generator().manual_seed(3))
        )
        model.get_parameter("deformation.layers.0.heads.bias")[3:6] = 0.0
    exported = export_scene(saved(tmp_path, model), tmp_path / "scene.onnx", times=3)
    assert exported.measured_error["quats"] <= tolerance("export.relative")
    session = DeformationSession(tmp_path / "scene.onnx")
    with torch.no_grad():
        expected = model.double().pose(0.5)
    got, wanted = session.gaussians(0.5).quats, expected.quats.numpy()
    chords = np.linalg.norm(got * np.sign((got * wanted).sum(axis=1, keepdims=True)) - wanted, axis=1)
    assert float(chords.max()) > 10 * tolerance("export.relative"), "some have turned"


def test_a_file_names_the_limits_that_it_does_not_hold() -> None:
    for near, most, named in ((0.01, 0.999, []), (0.2, 0.99, ["rasterizer"])):
        model = random_model(30, layers=(MLP,), near_plane=near, alpha_max=most)
        scene = bake(model, SCENE, "0" * 64).scene
        assert [entry["rule"] for entry in scene.metadata.left_out] == named
    assert "near plane 0.2 and largest alpha 0.99" in scene.metadata.left_out[0]["what"]

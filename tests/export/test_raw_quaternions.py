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


def test_a_file_names_the_limits_that_it_does_not_hold() -> None:
    for near, most, named in ((0.01, 0.999, []), (0.2, 0.99, ["rasterizer"])):
        model = random_model(30, layers=(MLP,), near_plane=near, alpha_max=most)
        scene = bake(model, SCENE, "0" * 64).scene
        assert [entry["rule"] for entry in scene.metadata.left_out] == named
    assert "near plane 0.2 and largest alpha 0.99" in scene.metadata.left_out[0]["what"]

"""Visionary's ONNX files compute what the scene does, in what its runtime accepts."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort
import pytest
from onnx import TensorProto, numpy_helper
from scipy.spatial.transform import Rotation

from msdgs_export.exporters.round_trip import visionary_of
from msdgs_export.exporters.visionary import visionary_model
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.framing import framing
from msdgs_serve.scene.gaussians import Gaussians
from msdgs_serve.scene.quaternion import to_matrix
from msdgs_train.gaussians.model_file import SceneInfo
from tests.support.conversions import run, scene_file
from tests.support.models import NODES, SCENE
from tests.support.tolerances import tolerance


@pytest.mark.slow
@pytest.mark.parametrize(
    ("plan", "config"),
    [
        ("network", {}),
        ("network", {"layers": ("plane", "mlp")}),
        ("network", {"layers": ("spline", "mlp"), "support": NODES}),
        ("compact:30", {}),
        ("compact:60", {}),
    ],
)
def test_visionary_computes_what_the_scene_does(tmp_path: Path, plan: str, config: dict[str, Any]):
    scene = scene_file(tmp_path, plan, **config)
    run(scene, tmp_path / "a.visionary.onnx")
    shown, session = visionary_of(tmp_path / "a.visionary.onnx"), DeformationSession(scene)
    for t in (0.0, 0.3, 0.77, 1.0):
        got, expected = shown(t), session.gaussians(t)
        assert np.abs(got.means - expected.means).max() <= tolerance("export.relative")
        ours, theirs = covariances(expected), covariances(got)
        assert np.abs(ours - theirs).max() <= tolerance("visionary.relative") * np.abs(ours).max()


def test_visionary_compares_times_of_a_range_whose_ends_round_outwards(tmp_path: Path):
    low, high = np.array(ends := (0.7, 1.6), np.float32).tolist()
    assert low < ends[0] < ends[1] < high
    run(scene_file(tmp_path, info=SceneInfo(time_range=ends, bounds=SCENE.bounds)), tmp_path / "a.visionary.onnx")
    assert (tmp_path / "a.visionary.onnx").is_file()


def covariances(g: Gaussians) -> np.ndarray:
    axes = to_matrix(g.quats.astype(np.float64)) * g.scales[:, None, :]
    return axes @ axes.transpose(0, 2, 1)


def test_visionary_scene_stands_upright_about_what_its_cameras_look_at(tmp_path: Path):
    scene = scene_file(tmp_path)
    run(scene, tmp_path / "a.visionary.onnx")
    stated = json.loads((tmp_path / "a.scene.json").read_text())
    metadata = DeformationSession(scene).scene.metadata
    (asset,) = stated["assets"]
    assert (tmp_path / asset["path"]).is_file()
    assert stated["env"]["bgColor"] == [*metadata.background, 1]
    x, y, z = asset["transform"]["rotationEulerRad"]
    turns = [Rotation.from_rotvec(angle * axis).as_matrix() for angle, axis in zip((x, y, z), np.eye(3), strict=True)]
    matrix, view = turns[0] @ turns[1] @ turns[2], framing(metadata)
    np.testing.assert_allclose(matrix @ view.up, [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(matrix @ view.target + asset["transform"]["position"], 0, atol=1e-12)


@pytest.mark.parametrize("plan", ["network", "compact:50"])
def test_visionary_accepts_the_model(tmp_path: Path, plan: str):
    """Visionary needs opset 17 only, no functions or control flow, finite constants of these types, empty padding."""
    model = visionary_model(scene_file(tmp_path, plan))
    outputs, rows = {each.name: each.type.tensor_type for each in model.graph.output}, 512
    shapes = {name: [each.dim_value for each in kind.shape.dim] for name, kind in outputs.items()}
    assert [(each.domain, each.version) for each in model.opset_import] == [("", 17)]
    assert [each.name for each in model.graph.input] == ["time"]
    assert shapes == {"gaussian_f32": [rows, 10], "color_f16": [rows, 48], "num_points": [1]}
    assert [kind.elem_type for kind in outputs.values()] == [TensorProto.FLOAT, TensorProto.FLOAT16, TensorProto.INT32]
    assert not model.functions
    assert not {node.op_type for node in model.graph.node} & {"If", "Loop", "Scan", "SequenceMap", "QuantizeLinear"}
    casts = {a.i for node in model.graph.node if node.op_type == "Cast" for a in node.attribute}
    allowed = {TensorProto.FLOAT, TensorProto.INT32, TensorProto.INT64, TensorProto.BOOL}
    assert casts | {each.data_type for each in model.graph.initializer if each.name != "harmonics"} <= allowed
    assert all(np.isfinite(numpy_helper.to_array(each)).all() for each in model.graph.initializer)
    session = ort.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    gaussians, count = session.run(["gaussian_f32", "num_points"], {"time": np.zeros(1, np.float32)})
    assert not np.asarray(gaussians)[int(np.asarray(count)[0]) :, 3].any()

"""Contract `msdgs/2`: opacities and colors that depend on time."""

import itertools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import helper, numpy_helper

from msdgs_serve.deformation import DeformationSession
from msdgs_serve.pose_cache import PoseCache
from msdgs_serve.render_job import RenderJob
from msdgs_serve.scene import Gaussians, SceneFileInvalid
from tests.support.images import decode
from tests.support.scene_files import GREEN, OPACITY, RED, constant_color, level_camera, metadata, write_scene
from tests.support.scenes import draw
from tests.support.service import FRAME, ORBIT, check_problem, serving
from tests.support.tolerances import tolerance

BOTH = ("opacities", "sh")


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return write_scene(tmp_path / "fading.onnx", changing=BOTH)


@pytest.mark.parametrize("changing", [part for n in range(3) for part in itertools.combinations(BOTH, n)], ids=str)
def test_what_changes_is_posed_and_everything_else_is_shared(tmp_path: Path, changing: tuple[str, ...]):
    session = DeformationSession(write_scene(tmp_path / "scene.onnx", changing=changing))
    assert session.scene.changing == changing
    green, red = constant_color(GREEN)[0], constant_color(RED)[0]
    for t in (0.0, 0.25, 1.0):
        g, left = session.gaussians(t), {name: 1 - t if name in changing else 1 for name in BOTH}
        np.testing.assert_allclose(g.opacities, [OPACITY * left["opacities"], OPACITY])
        np.testing.assert_allclose(g.sh, [green * left["sh"], red])
        assert [getattr(g, name) is getattr(session.scene, name) for name in BOTH] == [n not in changing for n in BOTH]
    assert [part.shape for part in session.pose(0.5, [])] == [(0, *part.shape[1:]) for part in session.pose(0.5)]
    cache = PoseCache(1 << 20)
    cache.get(session, 0.5, RenderJob())
    assert cache.use.bytes == 2 * 4 * (10 + ("opacities" in changing) + 3 * ("sh" in changing))


def test_the_service_draws_what_onnxruntime_alone_reads(path: Path):
    plain = onnxruntime.InferenceSession(path)
    names = [output.name for output in plain.get_outputs()]
    with serving(path, uploads=False) as client:
        assert client.get("/scenes/fading").json()["contract"] == "msdgs/2"
        frames = []
        for t in (0.0, 0.5, 1.0):
            out = dict(zip(names, plain.run(None, {"t": np.array([t], np.float32)}), strict=True))
            parts = ("means", "quats", "scales", "opacities", "sh")
            arrays = {part: np.concatenate([np.asarray(out[p]) for p in (part, f"static_{part}")]) for part in parts}
            want = draw(Gaussians(**arrays), level_camera(), background=metadata().background).rgb
            camera = {**ORBIT, "distance": 5, "fov_y": 40}
            body = {**FRAME, "t": t, "camera": camera, "width": 64, "height": 64}
            frames.append(decode(client.post("/render", json=body).content, "png")[0])
            assert np.abs(frames[-1] - want * 255).max() <= tolerance("served_frame.8bit")
    assert not np.array_equal(frames[0], frames[1])


def with_constant(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Callable[[onnx.ModelProto], object]:
    def changed(model: onnx.ModelProto) -> None:
        constant = next(each for each in model.graph.initializer if each.name == name)
        constant.CopyFrom(numpy_helper.from_array(change(numpy_helper.to_array(constant)), name))

    return changed


def as_first_contract(model: onnx.ModelProto) -> None:
    helper.set_model_props(model, {p.key: p.value.replace("msdgs/2", "msdgs/1") for p in model.metadata_props})


POISON: dict[str, tuple[str, str, Callable[[onnx.ModelProto], object]]] = {
    "opacity above 1": ("opacities", "outside [0, 1] at t = 0", with_constant("moving_opacities", lambda v: v + 1)),
    "opacity NaN": ("moving_opacities", "NaN", with_constant("moving_opacities", lambda v: v * np.float32(np.nan))),
    "color overflow": ("sh", "outside [-1e+30, 1e+30]", with_constant("moving_sh", lambda v: v * np.float32(1e31))),
    "static opacity": ("static_opacities", "outside [0, 1]", with_constant("all_static_opacities", lambda v: -v)),
    "static color": ("static_sh", "outside", with_constant("all_static_sh", lambda v: v * np.float32(1e31))),
    "more static opacities": ("static_opacities", "(2,)", with_constant("all_static_opacities", lambda v: v.repeat(2))),
    "other SH degree": ("sh", "[M, 4, 3], not [M, 1, 3]", with_constant("moving_sh", lambda v: v.repeat(4, 1))),
    "opacity matrix": ("opacities", "not [M]", with_constant("moving_opacities", lambda v: v[:, None])),
    "first contract": ("opacities", "depends on an input, but must be constant", as_first_contract),
}


@pytest.mark.parametrize("what", POISON)
def test_a_poisoned_file_is_refused_by_the_name_of_its_field(path: Path, what: str):
    field, message, change = POISON[what]
    model = onnx.load(path)
    change(model)
    with pytest.raises(SceneFileInvalid) as caught:
        DeformationSession("scene.onnx", contents=model.SerializeToString())
    assert caught.value.field == field
    assert message in str(caught.value)


def test_values_between_the_ends_are_checked_when_they_are_posed_and_uploads_in_the_middle(path: Path, tmp_path: Path):
    model = onnx.load(path)
    left = next(node for node in model.graph.node if node.output[0] == "left")
    left.output[0] = "rest"  # 1 - t is now (1 - t)(1 + 8 t), which is 2.5 at t = 1/2
    with_eight = numpy_helper.from_array(np.array([8], np.float32), "eight")
    model.graph.initializer.append(with_eight)
    added = [("Mul", ["t", "eight"], "much"), ("Add", ["much", "whole"], "more"), ("Mul", ["rest", "more"], "left")]
    at = list(model.graph.node).index(left) + 1
    for number, (operator, inputs, output) in enumerate(added):
        model.graph.node.insert(at + number, helper.make_node(operator, inputs, [output]))
    contents = model.SerializeToString()
    with pytest.raises(SceneFileInvalid, match=r"`opacities` holds NaN or values outside \[0, 1\] at t = 0.5"):
        DeformationSession("scene.onnx", contents=contents).gaussians(0.5)
    with serving(tmp_path, uploads=True) as client:
        response = client.post("/scenes", params={"name": "hostile"}, content=contents)
        check_problem(response, 422)
        assert "`opacities`" in response.json()["detail"]

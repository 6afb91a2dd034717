"""Every plan keeps the contract, and is as close to the float64 model as its file says."""

import json
from dataclasses import replace
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch

from msdgs_export.bake import Baked, bake
from msdgs_export.jobs.verify import verify
from msdgs_export.layers import LAYERS, ModelNotExportable
from msdgs_export.measure.poses import in_float64
from msdgs_export.measure.rendered_error import ExactFrames
from msdgs_export.measure.times import times_to_verify
from msdgs_export.measure.views import cameras_of, evaluation_views
from msdgs_export.plans.base import Plan
from msdgs_export.plans.network import network
from msdgs_export.plans.registry import PLANS, build, parse
from msdgs_export.supports import SUPPORTS
from msdgs_export.trajectories.sampling import Trajectories
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.rasterizer import GSPLAT
from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.gaussians.model import DynamicGaussians
from msdgs_train.layers.base import SceneBounds
from tests.support.models import BODIES, HASH4D, MLP, NODES, PLANE, SCENE, SPLINE, random_model
from tests.support.tolerances import tolerance

pytestmark = pytest.mark.slow

SLOW, COARSE = replace(MLP, time_frequencies=2), replace(PLANE, time_resolution=9)
ON_NODES = {"support": NODES, "noise": 0.02}
FORMATS: dict[str, dict[str, Any]] = {
    "mlp": {"layers": (SLOW, SLOW), "noise": 0.02},
    "plane": {"layers": (COARSE,)},
    "hash4d": {"layers": (HASH4D,), "scale_space": "linear", "weights": False, "noise": 0.02},
    "mixed": {"layers": (SLOW, COARSE), "noise": 0.02},
    "splines on nodes": {"layers": (SPLINE,), **ON_NODES},
    "mlp on nodes": {"layers": (SLOW, SLOW), **ON_NODES},
    "bodies on nodes": {"layers": (BODIES, SPLINE, SLOW), **ON_NODES},
    "plane on nodes": {"layers": (COARSE,), **ON_NODES},
    "mixed on nodes": {"layers": (SPLINE, COARSE, SLOW), **ON_NODES},
}


@cache
def made(kind: str, count: int = 60) -> tuple[DynamicGaussians, Baked]:
    model = random_model(count, **FORMATS[kind])
    return model, bake(model, SCENE, "0" * 64)


@cache
def sampled(kind: str, count: int = 60) -> Trajectories:
    return Trajectories(made(kind, count)[1])


def opened(path: Path, contents: onnx.ModelProto) -> DeformationSession:
    path.write_bytes(contents.SerializeToString())
    return DeformationSession(path)


def check_against_model(session: DeformationSession, model: DynamicGaussians, num_layers: int | None = None) -> None:
    for t in (0.0, 0.4):
        with torch.no_grad():
            expected = model.pose(t, num_layers)
        for got, name in zip(session.pose(t), ("means", "quats", "scales"), strict=True):
            assert np.abs(got - getattr(expected, name).numpy()).max() <= tolerance("export.relative")


@pytest.mark.parametrize("text", ["network", "prefix:3", "compact:20", "compact:90"])
def test_a_plan_is_its_text(text: str):
    assert str(parse(text)) == text
    assert parse(parse(text)) == parse(text)


UNKNOWN = """
    Network networks network:1 prefix prefix:0 prefix:-1 prefix:1.5 prefix:nan int8 int8:2 compact compact: compact:19
    compact:91 compact:5e1 compact:inf compact:५० compact:50.5 compact:-50 compact:50:4 lowrank:8 keyframes:9
"""


@pytest.mark.parametrize("text", [*UNKNOWN.split(), "", "compact:50 ", "network\n", "a" * 1000])
def test_an_unknown_plan_is_refused_with_those_that_exist(text: str):
    with pytest.raises(InvalidInput, match=r"`plan` must be one of: network; prefix:k.*; compact:d"):
        parse(text)


def test_a_plan_that_this_model_cannot_have_says_what_it_can():
    _, baked = made("plane")
    with pytest.raises(InvalidInput, match=r"prefix:k with k from 1 to 1"):
        build("prefix:2", baked)
    still = bake(random_model(20, layers=()), SCENE, "0" * 64)
    with pytest.raises(InvalidInput, match="prefix:k with k from 1 to 1"):
        build("prefix:7", still)


@pytest.mark.parametrize("kind", FORMATS)
def test_compact_has_about_its_predicted_error_in_frames_and_fewer_bytes_for_more(tmp_path: Path, kind: str):
    model, baked = made(kind)
    views = evaluation_views(cameras_of(SCENE), SCENE.time_range, 16, 2)
    exact, sizes = ExactFrames(in_float64(model), views, SCENE.background, GSPLAT), []
    for db in (60, 50, 40, 30):
        session = opened(tmp_path / "scene.onnx", build(f"compact:{db}", baked, sampled(kind)))
        sizes.append((tmp_path / "scene.onnx").stat().st_size)
        assert session.scene.metadata.plan == f"compact:{db}"
        measured = verify(session, model, times=9)
        assert measured["position"] <= measured["displacement"]
        fitted = session.scene.metadata.measured_error["fitted"]
        assert fitted["psnr"] >= db
        assert fitted["too_fast"] == 0
        assert exact.measure(session.gaussians, np.arange(60)).psnr_mean >= db - tolerance("compact.predicted")
    assert sizes == sorted(sizes, reverse=True)


def test_distances_in_the_file_are_those_of_a_plain_comparison_with_the_model(tmp_path: Path):
    model, baked = made("mlp")
    session = opened(tmp_path / "scene.onnx", build("compact:50", baked, sampled("mlp")))
    double = random_model(60, **FORMATS["mlp"]).double()
    worst = 0.0
    for t in times_to_verify(0.0, 1.0, 12):
        means, quats, _ = session.pose(t)
        expected = double.pose(t)
        worst = max(worst, float(np.linalg.norm(means - expected.means.detach().numpy(), axis=1).max()))
        np.testing.assert_allclose(np.linalg.norm(quats, axis=1), 1, atol=tolerance("float32.relative"))
    assert worst == pytest.approx(verify(session, model, times=12)["position"], rel=tolerance("float32.relative"))


@pytest.mark.parametrize(("plan", "most"), [("network", 2), ("prefix:1", 1), ("compact:40", 0)])
def test_plans_that_run_layers_can_stop_after_each(tmp_path: Path, plan: str, most: int):
    baked = bake(random_model(60, layers=("mlp", "mlp")), SCENE, "0" * 64)
    assert opened(tmp_path / "scene.onnx", build(plan, baked)).max_steps == most


@pytest.mark.parametrize("plan", ["prefix:1", "prefix:2", "compact:45"])
@pytest.mark.parametrize("ids", [[], [7], [59, 0, 5, 5]])
def test_rows_are_those_asked_for(tmp_path: Path, plan: str, ids: list[int]):
    _, baked = made("mlp")
    session = opened(tmp_path / "scene.onnx", build(plan, baked, sampled("mlp")))
    for some, every in zip(session.pose(0.3, ids), session.pose(0.3), strict=True):
        assert np.abs(some - every[ids]).max(initial=0) <= tolerance("export.relative")


@pytest.mark.parametrize("kind", FORMATS)
def test_prefix_is_the_model_stopped_early_and_network_the_whole_of_it(tmp_path: Path, kind: str):
    model, baked = made(kind)
    plans = {f"prefix:{k}": k for k in range(1, len(baked.layers) + 1)} | {"network": None}
    for plan, num_layers in plans.items():
        session = opened(tmp_path / "scene.onnx", build(plan, baked))
        assert session.scene.metadata.plan == plan
        check_against_model(session, model, num_layers)


@pytest.mark.parametrize("plan", ["network", "prefix:1", "compact:50"])
def test_a_scene_that_does_not_move_has_no_graph_under_any_plan(tmp_path: Path, plan: str):
    for model in (random_model(5, layers=()), random_model(0)):
        contents = build(plan, bake(model, SCENE, "0" * 64))
        assert not contents.graph.node
        assert opened(tmp_path / "scene.onnx", contents).scene.metadata.plan == plan


@pytest.mark.parametrize("plan", ["compact:30", "compact:70"])
def test_one_gaussian(tmp_path: Path, plan: str):
    model, baked = made("mlp", 1)
    session = opened(tmp_path / "scene.onnx", build(plan, baked, sampled("mlp", 1)))
    assert len(session.gaussians(0.5).validate()) == 1
    visible = np.linalg.norm(np.diff(SCENE.bounds, axis=0)) / 400  # a pixel
    assert verify(session, model, times=9)["displacement"] < visible


def test_a_time_range_of_one_time(tmp_path: Path):
    model = random_model(8, **FORMATS["mlp"])
    baked = bake(model, replace(SCENE, time_range=(0.25, 0.25)), "0" * 64)
    session = opened(tmp_path / "scene.onnx", build("compact:50", baked))
    assert verify(session, model, times=3)["position"] < tolerance("compact.pose")


@pytest.mark.parametrize(("plan", "row"), [("network", "export.relative"), ("compact:90", "compact.pose")])
@pytest.mark.parametrize("kind", ["plane", "splines on nodes"])
def test_times_that_do_not_begin_at_0(tmp_path: Path, kind: str, plan: str, row: str):
    """The motion is that of the same layers from 0 to 1."""
    settings: dict[str, Any] = FORMATS[kind] | {"noise": 0.2}
    some, ends = random_model(60, **settings), (2.0, 4.5)
    later = DynamicGaussians(some.config, some.gaussians, SceneBounds(1.0, ends))
    of_time = {name: values for name, values in later.named_buffers() if "time" in name}
    later.load_state_dict(some.state_dict() | of_time)
    first, second = (
        opened(tmp_path / f"{number}.onnx", build(plan, bake(model, replace(SCENE, time_range=times), "0" * 64)))
        for number, (model, times) in enumerate(((some, (0.0, 1.0)), (later, ends)))
    )
    poses = [(first.pose(part)[0], second.pose(2.0 + 2.5 * part)[0]) for part in (0.0, 0.44, 1.0)]
    assert np.abs(poses[1][0] - poses[0][0]).max() > 2 * tolerance(row)
    assert all(np.abs(a - b).max() <= tolerance(row) for a, b in poses)


def test_kinds_of_supports_and_layers_from_elsewhere_are_exported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    plugin = import_module("tests.support.plugin_example")
    support, fourier = plugin.ConfinedConfig(radius=0.8), plugin.FourierConfig(frequencies=2)
    model = random_model(60, layers=(fourier, SLOW, COARSE), support=support, noise=0.02)
    baked = bake(model, SCENE, "0" * 64)
    assert 0 < int((model.gaussians.means.norm(dim=1) < 0.8).sum()) < 60
    check_against_model(opened(tmp_path / "scene.onnx", build("network", baked)), model)
    with monkeypatch.context() as patch:
        patch.delitem(SUPPORTS, "confined")
        with pytest.raises(ModelNotExportable, match="'confined' can't be exported; those that can: gaussians, nodes"):
            build("network", baked)
    monkeypatch.delitem(LAYERS, "fourier")
    with pytest.raises(ModelNotExportable, match="'fourier' can't be exported; those that can: mlp"):
        build("network", baked)


def test_a_plan_from_elsewhere_is_parsed_and_built(monkeypatch: pytest.MonkeyPatch):
    mine = Plan(
        "mine", "mine:n, of size n", "#000000", lambda baked, spec, sample: network(baked, str(spec)), counts=range(9)
    )
    monkeypatch.setitem(PLANS, "mine", mine)
    properties = {p.key: p.value for p in build("mine:3", made("mlp")[1]).metadata_props}
    assert json.loads(properties["plan"]) == "mine:3"
    with pytest.raises(InvalidInput, match="mine:n, of size n"):
        parse("mine:9")

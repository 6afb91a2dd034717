"""Pruning: only what moves stays in the graph, each rule can be switched off, and the error allowed is kept."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch

from msdgs_export.bake import Baked
from msdgs_export.jobs import pruned_models, shared_trajectories
from msdgs_export.jobs.candidate import Candidate
from msdgs_export.jobs.ruler import CAMERAS_PER_TIME, ESTIMATE_STRIDE, EVALUATION_TIMES
from msdgs_export.jobs.write import write_scene
from msdgs_export.measure.poses import posed
from msdgs_export.measure.rendered_error import within_memory
from msdgs_export.measure.views import cameras_of, evaluation_views, selection_views
from msdgs_export.pruning import RULES
from msdgs_export.spatial_order import morton_order
from msdgs_export.trajectories.poses import QUATS, ExactPoses
from msdgs_export.trajectories.sampling import COARSE, Trajectories
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.rasterizer import rasterize
from msdgs_serve.scene import Gaussians
from msdgs_serve.scene.baked import BakedScene
from msdgs_serve.scene.errors import InvalidInput, SceneFileInvalid
from msdgs_train.evaluation.layer_strip import camera_of
from msdgs_train.evaluation.metrics import MAX_PSNR
from msdgs_train.gaussians.model import DynamicGaussians
from msdgs_train.gaussians.model_file import SceneInfo
from msdgs_train.layers.mlp import MLPLayer
from tests.support.exports import Parts, parts_of
from tests.support.images import psnr
from tests.support.models import (
    CAMERA,
    GROUND,
    MLP,
    NODES,
    OBJECT,
    SCENE,
    SHADING,
    moving_object,
    random_model,
    rise,
    saved,
)
from tests.support.tolerances import assert_close, tolerance

pytestmark = pytest.mark.slow

OBJECT_X = 0.6  # between the ground and the object


def exported(folder: Path, model: DynamicGaussians, info: SceneInfo = SCENE, **settings: Any) -> Parts:
    (folder / "candidates").mkdir()
    return parts_of(saved(folder, model, info), folder / "candidates", **settings)


def independent_worst_db(candidate: Candidate, model: DynamicGaussians, info: SceneInfo) -> float:
    """Return the PSNR of the worst frame, against the model in float64, at times that the export didn't use."""
    double, worst = model.double(), np.inf
    session, (t0, t1) = DeformationSession(candidate.path), info.time_range
    camera = camera_of(CAMERA, CAMERA["width"])
    for t in t0 + (t1 - t0) * np.random.default_rng(7).uniform(size=12):
        with torch.no_grad():
            posed = double.pose(float(np.float32(t)))
        exact = rasterize(Gaussians(*(x.numpy() for x in posed)), camera, background=info.background).rgb
        got = rasterize(session.gaussians(float(t)), camera, background=info.background).rgb
        worst = min(worst, psnr(np.clip(got, 0, 1), np.clip(exact, 0, 1)))
    return worst


@pytest.mark.parametrize("rules", [("invisible", "static"), tuple(RULES)])
@pytest.mark.parametrize("float32", ["exact", "not exact enough", "overflows"])
def test_trajectories_are_those_of_the_pruned_model(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rules: tuple[str, ...], float32: str
):
    """In float32 if it is exact enough: from pruning's statistics at their times, or else by the network."""

    def overflow(*args: Any) -> None:
        raise SceneFileInvalid("scene", "means", "overflow")

    monkeypatch.setattr(pruned_models, "ROUND_OFF_DB", MAX_PSNR if float32 == "not exact enough" else 0.0)
    if float32 == "overflows":  # at times that stability didn't try
        monkeypatch.setattr(shared_trajectories.SinglePoses, "at", overflow)
        monkeypatch.setattr(DeformationSession, "gaussians", overflow)
    made = list[tuple[Baked, Trajectories, bool]]()

    def trajectories(baked: Baked, *args: Any) -> Trajectories:
        with_sampler = len(args) == 4
        made.append((baked, Trajectories(baked, *args), not with_sampler))
        return made[-1][1]

    monkeypatch.setattr(shared_trajectories, "Trajectories", trajectories)
    exported(tmp_path, with_hidden_one(moving_object()), rules=rules).builder.candidate("compact:40", 50.0)
    ((baked, got, in_float64),) = made
    assert in_float64 == (float32 != "exact")
    every = np.arange(len(baked.moving))
    found = got.on_grid(COARSE + 1, every)
    for i in (0, 6, 7, COARSE):
        want = ExactPoses(baked).at(i / COARSE)
        want[:, QUATS] *= np.sign((want * found[:, i])[:, QUATS].sum(axis=1, keepdims=True))
        assert_close(found[:, i], want.astype(np.float32), "export.relative")


def test_everything_without_effect_is_pruned_and_listed(tmp_path: Path):
    parts = exported(tmp_path, with_hidden_one(moving_object()))
    candidate = parts.builder.candidate("network", 50.0)
    scene, means = candidate.session.scene, parts.model.gaussians.means[candidate.pruned.ids]
    left_out = {entry["rule"]: entry for entry in scene.metadata.left_out}
    assert set(left_out) == set(RULES)
    assert means[:, 2].min() > -2  # without the hidden one
    assert (means[: scene.moving_count, 0] > OBJECT_X).all()
    assert (means[scene.moving_count :, 0] < OBJECT_X).all()
    assert 0 < scene.moving_count <= OBJECT
    assert independent_worst_db(candidate, parts.model, SCENE) >= 50
    assert left_out["static"]["count"] == scene.static_count
    assert (left_out["layers"]["count"], left_out["layers"]["of"]) == (1, 2)
    assert (left_out["heads"]["count"], left_out["heads"]["of"]) == (2, 3)
    assert (left_out["sh"]["count"], left_out["modulation"]["count"]) == (1, 1)
    assert all(entry["worst_frame_db"] >= 50 for entry in left_out.values())
    assert scene.metadata.layers == ("mlp",)
    graph = onnx.load(candidate.path).graph
    stored = {tensor.name: tensor.dims for tensor in graph.initializer}
    assert list(stored["layer1.heads.weight"]) == [4, 32]  # means and the weight
    assert "scale_modulation" not in stored


KEPT: dict[str, Callable[[BakedScene], bool]] = {
    "static": lambda scene: scene.static_count == 0,
    "invisible": lambda scene: len(scene) == GROUND + OBJECT,
    "layers": lambda scene: len(scene.metadata.layers) == 2,
    "sh": lambda scene: scene.metadata.sh_degree == 1,
}
"""The part of a scene that each rule would remove."""


@pytest.mark.parametrize("rule", [*RULES, None])
def test_a_rule_that_is_switched_off_removes_nothing(tmp_path: Path, rule: str | None):
    off = [rule] if rule else list(RULES)
    others = [name for name in RULES if name not in off]
    builder = exported(tmp_path, with_hidden_one(moving_object()), rules=others).builder
    scene = builder.candidate("network", 50.0).session.scene
    assert not {entry["rule"] for entry in scene.metadata.left_out} & set(off)
    assert all(KEPT[name](scene) for name in off if name in KEPT)


def test_a_prefix_has_the_first_layers_as_trained(tmp_path: Path):
    """Although the model does without one of them."""
    model = moving_object(moves=False, layers=(replace(MLP, depth=1),) * 3)
    with torch.no_grad():
        rise(model.deformation.layers[1])
        rise(model.deformation.layers[2])
    parts = exported(tmp_path, model)
    assert parts.builder.pruning.at(50.0).network.layers == (1, 2)
    candidate = parts.builder.candidate("prefix:2", 50.0)
    scene, ids = candidate.session.scene, candidate.pruned.ids
    assert (len(scene.metadata.layers), scene.metadata.plan) == (2, "prefix:2")
    assert "layers" not in {entry["rule"] for entry in scene.metadata.left_out}
    assert 0 < scene.moving_count <= OBJECT
    want = parts.model.pose(1.0, 2).means.numpy()[ids[: scene.moving_count]]
    assert_close(candidate.session.pose(1.0)[0], want, "export.relative")
    parts.builder.candidate("prefix:3", 50.0)
    with pytest.raises(InvalidInput, match="prefix:k with k from 1 to 3"):
        parts.builder.candidate("prefix:4", 50.0)


def test_layers_too_expensive_to_test_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("msdgs_export.pruning.rules.MAX_OPERATIONS", 0.0)
    pruned = exported(tmp_path, moving_object()).builder.pruning.at(45.0)
    left_out = {entry["rule"] for entry in pruned.left_out}
    assert "layers" not in left_out
    assert "static" in left_out
    assert len(pruned.moving.deformation) == 2


@pytest.mark.parametrize("pruning_db", [30.0, 45.0, 60.0])
def test_the_error_bound_holds_in_other_frames(tmp_path: Path, pruning_db: float):
    model = random_model(400, sh_degree=1, noise=0.02)
    parts = exported(tmp_path, model)
    candidate = parts.builder.candidate("network", pruning_db)
    assert parts.ruler.error(candidate).psnr_worst >= pruning_db
    # at other times a frame may be slightly worse
    assert independent_worst_db(candidate, model, SCENE) >= pruning_db - tolerance("pruning.other_times_db")


def test_a_higher_psnr_prunes_less(tmp_path: Path):
    parts = exported(tmp_path, random_model(400, sh_degree=1, noise=0.02))
    sizes = [parts.builder.candidate("network", pruning_db).size for pruning_db in (30.0, 55.0, None)]
    assert sizes == sorted(sizes)
    assert sizes[0] < sizes[-1]


def test_an_error_of_zero_is_found_for_the_whole_network(tmp_path: Path):
    parts = exported(tmp_path, moving_object())
    error = parts.ruler.error(parts.builder.candidate("network", None))
    assert error.psnr_worst >= tolerance("export.float32_db")
    assert error.position <= tolerance("export.relative")


def test_a_change_of_one_gaussian_is_measured(tmp_path: Path):
    model = moving_object()
    parts = exported(tmp_path, model)
    ids = np.arange(GROUND + OBJECT)
    moved = 0.125

    def pose(t: float) -> Gaussians:
        g = parts.ruler.exact.pose(t)
        means = g.means.copy()
        means[-1] += [0, moved, 0]
        return Gaussians(means, g.quats, g.scales, g.opacities, g.sh)

    error = parts.ruler.exact.measure(pose, ids)
    np.testing.assert_allclose(error.position, moved, rtol=tolerance("float32.relative"))
    assert error.worst_pixel > 0
    assert error.psnr_worst <= error.psnr_mean
    depth = 4 - 1  # the camera is at z = -4, and no point nearer than z = -1
    assert 0 < error.position_pixels <= moved * CAMERA["fx"] / depth


def test_selection_times_are_not_evaluation_times():
    cameras = cameras_of(SCENE)
    deciding = {view.t for view in selection_views(cameras, (0.0, 1.0), 33)}
    measured = {view.t for view in evaluation_views(cameras, (0.0, 1.0), 16, 3)}
    assert (len(deciding), len(measured)) == (33, 16)
    assert deciding & measured == {0.0, 1.0}


def test_with_less_memory_for_frames_pruning_is_still_decided_all_over_time(monkeypatch: pytest.MonkeyPatch):
    views = selection_views(cameras_of(SCENE), (0.0, 1.0), 33, 3)
    frame = 12 * views[0].camera.width * views[0].camera.height
    for count in (50, 25, 11):
        monkeypatch.setattr("msdgs_export.measure.rendered_error.MEMORY", count * frame)
        times = [view.t for view in within_memory(views, 0)]
        assert len(set(times)) == min(count, 33)
        assert (min(times), max(times)) == (0.0, 1.0)


def test_quick_estimates_see_early_and_late_cameras():
    views = evaluation_views(cameras_of(SCENE), (0.0, 1.0), EVALUATION_TIMES, CAMERAS_PER_TIME)
    names = sorted(name for name, _ in cameras_of(SCENE))
    positions = [names.index(view.name) / len(names) for view in views[::ESTIMATE_STRIDE]]
    assert min(positions) < 0.2
    assert max(positions) > 0.6


def test_cameras_of_training_and_viewer_are_used():
    info = SceneInfo(cameras=SCENE.cameras[:3], training_cameras=SCENE.cameras[10:15])
    training = [f"training r_{i:03}" for i in range(10, 15)]
    assert [name for name, _ in cameras_of(info)] == [*training, "r_000", "r_001", "r_002"]


def test_one_camera_at_several_times_counts_once():
    stored = [SCENE.cameras[0] | {"name": f"video {i}", "t": i / 9} for i in range(10)]
    names = [name for name, _ in cameras_of(SceneInfo(cameras=stored, bounds=SCENE.bounds))]
    assert names[0] == "video 0"
    assert all(name.startswith("added") for name in names[1:])
    assert len(names) > 4


@pytest.mark.parametrize("count", [0, 1, 3])
def test_cameras_are_added_where_too_few_are_stored(count: int):
    cameras = cameras_of(SceneInfo(cameras=SCENE.cameras[:count], bounds=SCENE.bounds))
    assert len(cameras) > count
    for _, camera in cameras[count:]:  # the scene's middle is in the middle of their images
        in_camera = camera.world_to_camera @ [0, 0, 0, 1]
        assert in_camera[2] > 0
        assert np.abs(in_camera[:2]).max() < tolerance("pixel")


@pytest.mark.parametrize(
    ("count", "changes", "info"),
    [
        (0, {}, SCENE),
        (1, {}, SCENE),
        (5, {"layers": ()}, SCENE),
        (5, {"layers": (), "embedding_dim": 0}, SCENE),
        (40, {"layers": ("plane", "mlp")}, SCENE),
        (40, {"support": NODES, "layers": ("spline",)}, SCENE),
        (40, {"support": NODES, "layers": ("spline", "mlp")}, SCENE),
        (40, {"support": NODES, "layers": (SHADING,), "noise": 0.2}, SCENE),
        (40, {"support": NODES, "layers": ("mlp", "plane")}, SCENE),
        (40, {"weights": False, "modulation_targets": ("means", "scales", "quats")}, SCENE),
        (40, {"scale_space": "linear"}, SCENE),
        (40, {}, SceneInfo(bounds=SCENE.bounds)),
        (40, {}, SceneInfo(time_range=(0.5, 0.5), bounds=SCENE.bounds, cameras=SCENE.cameras[:2])),
    ],
)
def test_unusual_scenes_are_pruned_and_written(tmp_path: Path, count: int, changes: dict[str, Any], info: SceneInfo):
    parts = exported(tmp_path, random_model(count, **changes), info)
    candidate = parts.builder.candidate("network", 50.0)
    error = parts.ruler.error(candidate)
    assert error.psnr_worst >= 50
    contents = onnx.load(candidate.path)
    written = write_scene(tmp_path / "s.onnx", contents, candidate.pruned.moving, rendered=error.to_plain(), times=4)
    assert written.measured_error["rendered"]["psnr_worst"] == error.psnr_worst
    assert written.moving_count + written.static_count == len(candidate.pruned.ids)


def test_gaussians_that_appear_later_are_kept_and_those_that_never_change_are_static(tmp_path: Path):
    model = moving_object(opacity_head=True, sh_head=True)
    layer = model.deformation.layers[0]
    with torch.no_grad():
        assert isinstance(layer, MLPLayer)
        layer.heads.weight[1].zero_()  # nothing moves
        layer.heads.weight[layer.outputs.columns["opacities"], :2] = torch.tensor([4.0, -4.0])  # 8 t, times 1 / 2
        model.gaussians.raw_opacities[GROUND:] = -6.0
        model.gaussians.sh_dc[:GROUND] *= 0.5
    parts = exported(tmp_path, model)
    candidate = parts.builder.candidate("network", 50.0)
    scene, means = candidate.session.scene, parts.model.gaussians.means[candidate.pruned.ids]
    assert (scene.changing, scene.metadata.sh_degree) == (("opacities", "sh"), 0)
    assert (means[: scene.moving_count, 0] > OBJECT_X).all()
    assert 0.5 * OBJECT < scene.moving_count <= OBJECT
    assert parts.ruler.error(candidate).psnr_worst >= 50
    assert independent_worst_db(candidate, parts.model, SCENE) >= 50
    written = write_scene(tmp_path / "s.onnx", onnx.load(candidate.path), candidate.pruned.moving, times=4)
    assert written.measured_error["opacities"] <= tolerance("export.relative")


@pytest.mark.parametrize("is_seen", [True, False])
def test_shading_is_left_out_if_it_changes_nothing(tmp_path: Path, is_seen: bool):
    model = random_model(40, noise=0.2, support=NODES, layers=(SHADING, "mlp"), embedding_dim=0)
    with torch.no_grad():
        gains = model.get_parameter("deformation.layers.0.gains")
        gains *= float(is_seen)
    parts = exported(tmp_path, model)
    candidate = parts.builder.candidate("network", 50.0)
    assert candidate.session.scene.changing == (("sh",) if is_seen else ())
    left_out = {entry["rule"]: entry for entry in candidate.pruned.left_out}
    assert ("heads" in left_out) != is_seen
    if not is_seen:
        assert left_out["heads"]["bytes_saved"] == 4 * gains.numel()
        assert not parts.builder.candidate("compact:40", 50.0).session.scene.changing
    else:
        with pytest.raises(InvalidInput, match="sh change"):
            parts.builder.candidate("compact:40", 50.0)


def test_a_prefix_without_the_layer_that_shades_has_constant_colors(tmp_path: Path):
    model = random_model(40, noise=0.2, support=NODES, layers=("mlp", SHADING), embedding_dim=0)
    parts = exported(tmp_path, model)
    for plan, changing in (("prefix:1", ()), ("network", ("sh",))):
        session = parts.builder.candidate(plan, None).session
        assert session.scene.changing == changing
        first, last = (session.gaussians(t).sh for t in (0.0, 0.9))
        assert np.array_equal(first, last) == (plan == "prefix:1")


@pytest.mark.parametrize("kind", ["spline", "bodies", "mlp", "plane"])
def test_layers_on_nodes_keep_all_heads(tmp_path: Path, kind: str):
    """The file moves Gaussians as the model does, whose order alone is changed."""
    model = random_model(40, noise=0.2, support=NODES, layers=(kind,))
    parts = exported(tmp_path, model)
    assert "heads" not in {entry["rule"] for entry in parts.builder.candidate("network", 50.0).pruned.left_out}
    candidate = parts.builder.candidate("network", None)
    order = morton_order(model.gaussians.means.detach().numpy())
    start, end = (posed(model, t) for t in SCENE.time_range)
    assert np.abs(end.means - start.means).max() > 0.01
    for got, want in zip(candidate.session.pose(1.0), (end.means, end.quats, end.scales), strict=True):
        np.testing.assert_allclose(got, want[order], rtol=0, atol=tolerance("export.relative"))


def with_hidden_one(model: DynamicGaussians) -> DynamicGaussians:
    """Move the object's first Gaussian behind all cameras."""
    with torch.no_grad():
        model.gaussians.means[GROUND] = torch.tensor([0.0, 0.0, -50.0])
    return model

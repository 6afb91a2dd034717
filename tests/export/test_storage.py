"""Arrays in fewer bits: each kind against float64, every plan, and files whose frames have the error that they say."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import onnx
import onnxruntime as ort
import pytest
import torch
from onnx import TensorProto

from msdgs_export.bake import bake
from msdgs_export.cli.convert import main as convert_main
from msdgs_export.cli.to_onnx import main
from msdgs_export.exporters.round_trip import RoundTrip
from msdgs_export.importers.sequence import Frames, sequence_scene
from msdgs_export.jobs import packing
from msdgs_export.jobs.checkpoint import Checkpoint
from msdgs_export.jobs.ruler import Ruler
from msdgs_export.jobs.write import properties, set_properties
from msdgs_export.layers.graph import GraphBuilder
from msdgs_export.measure.poses import posed
from msdgs_export.measure.views import cameras_of
from msdgs_export.options import ConvertOptions, ExportOptions, Kept
from msdgs_export.plans.registry import build
from msdgs_export.storage import choice
from msdgs_export.storage.choice import COARSEST, GROUPS, fewest_bytes, packed, smallest_error
from msdgs_export.storage.kinds import Pack, directions, fractions, in_range, logarithms, low_rank
from msdgs_export.trajectories.sampling import Trajectories
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.process import EXIT_INVALID
from msdgs_serve.scene import Gaussians
from msdgs_serve.scene.baked import MOVING_OUTPUTS
from msdgs_train.gaussians.model_file import load_model
from tests.support import reference_torch
from tests.support.images import psnr
from tests.support.models import BODIES, HASH4D, MLP, NODES, SCENE, SHADING, moving_object, random_model, saved
from tests.support.scenes import unit_quats
from tests.support.sound_scenes import RESOLVED
from tests.support.splat_files import inria_columns, ply_bytes, some_gaussians
from tests.support.tolerances import tolerance

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("few_candidates")]

FLOAT32: tuple[Kept, ...] = ("float32",)
FINE = {name: list(group.kinds)[-1] for name, group in GROUPS.items()}


def unfolded(pack: Pack, values: np.ndarray) -> tuple[np.ndarray, int]:
    """The array that onnxruntime computes, and the bytes of the stored integers."""
    graph = GraphBuilder()
    assert pack(graph, "x", values.astype(np.float32)) == "x"
    model = graph.model({"t": (TensorProto.FLOAT, [1])}, {"x": list(values.shape)}, {})
    session = ort.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    (got,) = session.run(["x"], {"t": np.zeros(1, np.float32)})
    return np.asarray(got, np.float64), max(len(each.raw_data) for each in graph.constants.values())


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("count", [1, 2, 500])
def test_each_kind_is_off_by_half_a_step(bits: int, count: int):
    rng = np.random.default_rng(count)
    columns = [rng.normal(size=count), np.full(count, -7.25), np.zeros(count), 1e30 * rng.normal(size=count),
               1e-38 * rng.normal(size=count), 1e6 + rng.normal(size=count)]  # fmt: skip
    values = np.stack(columns, axis=1).astype(np.float32).astype(np.float64)
    ranges, largest = np.ptp(values, axis=0), np.abs(values).max(axis=0)
    got, stored = unfolded(in_range(bits), values)
    rounding = tolerance("float32.relative") * largest + np.finfo(np.float32).tiny
    assert (np.abs(got - values) <= ranges / (2**bits - 1) / 2 + rounding).all()
    assert (got[:, 1:3] == values[:, 1:3]).all()
    assert stored >= values.size * bits // 8

    scales = np.exp(rng.uniform(-18, 18, (count, 3)))
    got, _ = unfolded(logarithms(bits), scales)
    assert np.abs(np.log(got / scales)).max() <= 36 / (2**bits - 1) / 2 + tolerance("stored_scale")

    opacities = np.append(rng.uniform(size=count), [0, 1])
    got, _ = unfolded(fractions(bits, 1.0), opacities)
    assert np.abs(got - opacities).max() <= 1 / (2 ** min(bits, 15) - 1) / 2 + tolerance("float32.relative")
    assert (got[-2:] == [0, 1]).all()
    assert got.max() <= 1

    quats = np.concatenate([unit_quats(rng, count), np.eye(4)])
    got, _ = unfolded(directions(bits), quats)
    np.testing.assert_allclose(np.linalg.norm(got, axis=1), 1, atol=tolerance("float32.relative"))
    assert np.abs(got - quats).max() <= 2 / (2 ** (bits - 1) - 1)


@pytest.mark.parametrize("rank", [1, 5, 8, 12, 40])
def test_a_low_rank_leaves_out_the_smallest_singular_values(rank: int):
    rng = np.random.default_rng(rank)
    values = rng.normal(size=(30, 12)) @ (rng.normal(size=(12, 200)) * 0.5 ** np.arange(12)[:, None])
    _, sizes, columns = np.linalg.svd(values, full_matrices=False)
    got, stored = unfolded(low_rank(rank), values)
    steps = np.ptp(columns, axis=1) / np.where(np.arange(len(columns)) < 8, 2**16 - 1, 2**8 - 1) / 2
    rounding = (sizes * steps)[:rank].sum() + tolerance("float32.relative") * sizes[0]
    assert np.abs(got - values).max() <= rounding + sizes[rank:].sum()
    assert stored == 200 * max(2 * min(rank, 8), min(rank, 30) - 8)


MODELS: dict[str, dict[str, Any]] = {
    "mlp": {"layers": (replace(MLP, xyz_frequencies=2),) * 2, "noise": 0.02},
    "plane": {"layers": ("plane",), "modulation_targets": ("quats", "means")},
    "nodes": {"layers": ("spline", "mlp"), "support": NODES, "noise": 0.02, "embedding_dim": 0},
    "shading": {"layers": (SHADING,), "support": replace(NODES, num_nodes=99), "noise": 0.02, "embedding_dim": 0},
    "bodies": {"layers": (BODIES,), "support": replace(NODES, num_nodes=99), "noise": 0.02, "embedding_dim": 0},
    "still": {"layers": ()},
    "hash4d": {"layers": (HASH4D,), "scale_space": "linear", "weights": False, "noise": 0.02, "embedding_dim": 0},
}
PLANS = ("network", "prefix:1", "compact:40", "compact:60")


@pytest.mark.parametrize(
    ("kind", "plan"), [(kind, plan) for kind in MODELS for plan in PLANS[: 2 if kind == "shading" else None]]
)
def test_every_plan_works_with_storage(tmp_path: Path, kind: str, plan: str):
    baked = bake(random_model(400, **MODELS[kind]), SCENE, "0" * 64)
    contents = build(plan, baked, Trajectories(baked, resolved=RESOLVED) if plan.startswith("compact") else None)
    (tmp_path / "exact.onnx").write_bytes(contents.SerializeToString())
    exact = DeformationSession(tmp_path / "exact.onnx")
    sizes, errors = [contents.ByteSize()], []
    for kinds in (FINE, COARSEST):
        model = packed(contents, kinds)
        onnx.checker.check_model(model)
        session = DeformationSession(tmp_path / "x.onnx", contents=model.SerializeToString())
        assert session.scene.moving_count == exact.scene.moving_count
        got, want = session.gaussians(0.4).validate(), exact.gaussians(0.4)
        errors.append(max(float(np.abs(getattr(got, name) - getattr(want, name)).max()) for name in vars(got)))
        sizes.append(model.ByteSize())
    assert sizes == sorted(sizes, reverse=True)
    assert 0 < errors[0] < tolerance("stored_16bit")
    assert errors[1] < tolerance("stored_8bit")


def test_each_group_has_arrays_of_some_scene():
    frames = Frames((some_gaussians(20, 0), some_gaussians(21, 0)), 0, "dilate", blended=False)
    models = {kind: bake(random_model(400, **settings), SCENE, "0" * 64) for kind, settings in MODELS.items()}
    scenes = [sequence_scene(frames, "0" * 64), *(build("network", baked) for baked in models.values())]
    scenes.append(build("compact:60", models["mlp"], Trajectories(models["mlp"], resolved=RESOLVED)))
    names = {each.name for scene in scenes for each in scene.graph.initializer}
    groups = {next(n for n, group in GROUPS.items() if re.fullmatch(group.names, name)) for name in names}
    assert groups == set(GROUPS)


def test_a_written_file_is_smaller_and_its_frames_have_the_error_that_it_says(tmp_path: Path):
    checkpoint = saved(tmp_path, moving_object())
    sizes = {}
    for keep in (FLOAT32, ()):
        output = tmp_path / f"{len(keep)}.onnx"
        assert main(ExportOptions(checkpoint, output, plan="network", min_psnr=45.0, keep=keep, times=4)) == 0
        sizes[len(keep)] = output.stat().st_size
    scene = DeformationSession(output).scene
    (entry,) = (each for each in scene.metadata.left_out if each["rule"] == "float32")
    kept = DeformationSession(tmp_path / "1.onnx").scene.metadata
    assert "float32" not in {each["rule"] for each in kept.left_out}
    assert "storage" not in kept.measured_error
    assert entry["count"] == entry["bytes_saved"] > 0
    assert set(scene.metadata.measured_error["storage"]) == set(MOVING_OUTPUTS)
    rendered = scene.metadata.measured_error["rendered"]
    assert rendered["psnr_worst"] == entry["worst_frame_db"] >= 45
    again = psnr_by_other_programs(output, checkpoint, **rendered["worst_frame"])
    assert again == pytest.approx(rendered["psnr_worst"], abs=tolerance("redrawn"))
    assert sizes[0] < sizes[1]
    session, any_ids = DeformationSession(output), np.zeros(len(scene), int)  # which only distances depend on
    drawn = Ruler(Checkpoint.load(checkpoint)).exact.measure(session.gaussians, any_ids)
    assert drawn.psnr_worst == rendered["psnr_worst"]


def psnr_by_other_programs(scene: Path, checkpoint: Path, camera: str, t: float) -> float:
    """A frame's PSNR against the model in float64: posed by plain onnxruntime, drawn by gsplat's reference."""
    model, info, _ = load_model(checkpoint)
    seen = dict(cameras_of(info))[camera]

    def frame(g: Gaussians) -> np.ndarray:
        parts = {name: torch.from_numpy(np.asarray(values, np.float64)) for name, values in vars(g).items()}
        opacities, background = parts.pop("opacities"), torch.tensor(info.background, dtype=torch.float64)
        splats = reference_torch.project(**parts, camera=seen, options=model.rasterizer)
        return reference_torch.render(splats, opacities, seen, background, model.rasterizer)[0].numpy()

    options = ort.SessionOptions()
    options.log_severity_level = 3
    session = ort.InferenceSession(str(scene), options)
    names = [output.name for output in session.get_outputs()]
    got: dict[str, Any] = dict(zip(names, session.run(None, {"t": np.array([t], np.float32)}), strict=True))
    poses = {name: np.concatenate([got[name], got[f"static_{name}"]]) for name in MOVING_OUTPUTS}
    frames = frame(Gaussians(**poses, opacities=got["opacities"], sh=got["sh"])), frame(posed(model.double(), t))
    return psnr(*(np.clip(each, 0, 1) for each in frames))


@pytest.mark.parametrize(("kind", "count"), [("nodes", 400), ("still", 400), ("still", 1100)])
def test_a_scene_file_is_stored_anew(tmp_path: Path, kind: str, count: int, monkeypatch: pytest.MonkeyPatch):
    """The worst of other frames has about the stated PSNR, too. Kinds of the last are chosen by every second
    Gaussian."""
    monkeypatch.setattr(packing, "SAMPLE", 600)
    thinned = Mock(side_effect=packing._thinned)
    monkeypatch.setattr(packing, "_thinned", thinned)
    scene, out = tmp_path / "scene.onnx", tmp_path / "small.onnx"
    contents = build("network", bake(random_model(count, **MODELS[kind]), SCENE, "0" * 64))
    set_properties(contents, measured_error={"means": 0.25, "rendered": {"psnr_worst": 70.0}})
    scene.write_bytes(contents.SerializeToString())
    assert convert_main(ConvertOptions(scene, out, min_psnr=40.0)) == 0
    assert thinned.called == (count > packing.SAMPLE)
    exact, small = DeformationSession(scene), DeformationSession(out)
    metadata = small.scene.metadata
    (entry,) = (each for each in metadata.left_out if each["rule"] == "float32")
    assert out.stat().st_size < 0.75 * scene.stat().st_size
    assert entry["worst_frame_db"] >= 40
    assert set(metadata.measured_error) == {"means", "storage"}
    assert metadata.measured_error["means"] == 0.25
    assert max(metadata.measured_error["storage"].values()) > 0
    check = RoundTrip(exact)
    assert 37 < min(check.psnr(small.gaussians(t), t) for t in (0.13, 0.57, 0.91)) < 70
    before = out.read_bytes()
    for min_psnr in (101.0, 5.0):
        assert convert_main(ConvertOptions(scene, out, min_psnr=min_psnr)) == EXIT_INVALID
    scene.write_bytes(build("network", bake(random_model(1, layers=()), SCENE, "0" * 64)).SerializeToString())
    assert convert_main(ConvertOptions(scene, out)) == EXIT_INVALID  # all arrays are small
    assert out.read_bytes() == before


def test_a_file_of_too_many_values_is_not_stored_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(choice, "MAX_VALUES", 1000)
    monkeypatch.setattr(packing, "SAMPLE", 50)
    scene, out = tmp_path / "scene.onnx", tmp_path / "small.onnx"
    contents = build("network", bake(random_model(400, **MODELS["still"]), SCENE, "0" * 64))
    scene.write_bytes(contents.SerializeToString())
    assert convert_main(ConvertOptions(scene, out)) == EXIT_INVALID
    assert not out.exists()


@pytest.mark.parametrize("name", ["frames.scales", "sizes"])
def test_scales_of_a_wide_range_stay_above_zero(tmp_path: Path, name: str):
    """By their logarithms; or as they are, where equal steps would round the smallest to 0."""
    frames = tuple(some_gaussians(count, 0) for count in (200, 201))
    for frame in frames:
        frame.scales[:, 2] = 1e-8
        frame.scales[0] = 2
    contents = sequence_scene(Frames(frames, 0, "dilate", blended=False), "0" * 64)
    for each in (*contents.graph.initializer, *contents.graph.node):
        each.name = each.name.replace("frames.scales", name)
    for node in contents.graph.node:
        node.input[:] = [given.replace("frames.scales", name) for given in node.input]
    (tmp_path / "frames.onnx").write_bytes(contents.SerializeToString())
    assert convert_main(ConvertOptions(tmp_path / "frames.onnx", tmp_path / "small.onnx")) == 0
    session = DeformationSession(tmp_path / "small.onnx")
    (entry,) = session.scene.metadata.left_out
    assert {"mean scales", "other"} & entry["stored"].keys() == ({"mean scales", "other"} if name != "sizes" else set())
    for t in (0.0, 1.0):
        assert session.gaussians(t).scales.min() > 0


def test_imported_splats_are_stored_alike(tmp_path: Path):
    splats, out = tmp_path / "a.ply", tmp_path / "a.onnx"
    splats.write_bytes(ply_bytes(inria_columns(some_gaussians(300))))
    sizes = []
    for keep in (FLOAT32, ()):
        assert main(ExportOptions(splats, out, keep=keep)) == 0
        sizes.append(out.stat().st_size)
    metadata = DeformationSession(out).scene.metadata
    (entry,) = metadata.left_out
    assert entry["worst_frame_db"] >= 50
    assert sizes[0] - entry["bytes_saved"] == pytest.approx(sizes[1], abs=1000)  # metadata
    assert set(metadata.measured_error["storage"]) == set(MOVING_OUTPUTS)


@pytest.mark.parametrize(
    ("count", "layers", "packs"), [(0, ("mlp",), False), (1, ("mlp",), True), (1, (), False), (300, (), True)]
)
def test_unusual_scenes_are_written(tmp_path: Path, count: int, layers: tuple[str, ...], packs: bool):
    model = random_model(count, layers=layers)
    assert main(ExportOptions(saved(tmp_path, model), quick=True, keep=("invisible",), times=2)) == 0
    stored = properties(onnx.load(tmp_path / "model.onnx"))["left_out"]
    assert ("float32" in {entry["rule"] for entry in stored}) == packs


def test_the_group_of_the_largest_error_per_byte_becomes_finer_first():
    contents = build("network", bake(random_model(400), SCENE, "0" * 64))

    def estimate(model: onnx.ModelProto) -> float:
        names = {each.name: each.data_type for each in model.graph.initializer}
        return 1.0 + 4.0 * (names.get("sh.stored") == TensorProto.UINT8) + 2.0 * ("opacities.stored" in names)

    def chosen(allowed: float, is_allowed: bool = True) -> dict[str, str] | None:
        found = fewest_bytes(contents, estimate, lambda model: is_allowed and estimate(model) - 1.0 <= allowed)
        return found and found.kinds

    everything = chosen(10.0)
    assert everything is not None
    assert (everything["sh"], everything["opacities"]) == ("8 bits", "8 bits")
    # 2 per byte for 400 opacities, 4 for 400 · 16 · 3 values of SH, and their 16 bits are no more exact
    without = {name: kind for name, kind in everything.items() if name != "opacities"}
    assert chosen(5.0) == without
    assert chosen(0.0) == without | {"sh": "16 bits"}
    assert chosen(10.0, is_allowed=False) is None

    # what no estimate shows becomes finer last, but before the whole file stays as it is
    def seen(model: onnx.ModelProto) -> bool:
        return "opacities.stored" not in {each.name for each in model.graph.initializer}

    found = fewest_bytes(contents, lambda model: 1.0, seen)
    assert found is not None
    assert "opacities" not in found.kinds
    assert found.kinds

    # the same order if bytes are limited, and no byte for what has no error
    smallest = packed(contents, COARSEST).ByteSize()
    assert smallest_error(contents, estimate, 0).kinds == everything
    assert smallest_error(contents, estimate, smallest + 1300).kinds == without
    finest = smallest_error(contents, estimate, 10**9)
    assert finest.kinds == {name: kind for name, kind in without.items() if name != "sh"} | {"sh": "16 bits"}
    for most in range(smallest, finest.contents.ByteSize(), 997):
        assert smallest_error(contents, estimate, most).contents.ByteSize() <= most

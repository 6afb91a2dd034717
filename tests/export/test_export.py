"""`msdgs-export`: the contents of the scene file, and that an old file survives every failure."""

import hashlib
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch
from rich.console import Console

from msdgs_export.bake import bake, starting_cameras
from msdgs_export.cli.export import export_or_import
from msdgs_export.cli.stability import main as stability
from msdgs_export.cli.to_onnx import main as to_onnx
from msdgs_export.exporters.command import convert
from msdgs_export.jobs.verify import VerificationFailed, verify
from msdgs_export.layers.graph import GraphBuilder
from msdgs_export.measure.images import HeldOutImages
from msdgs_export.measure.times import times_to_verify
from msdgs_export.options import ConvertOptions, ExportOptions
from msdgs_export.plans.registry import build
from msdgs_serve import __version__
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.process import EXIT_INVALID
from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.scene.quaternion import to_matrix
from msdgs_train.datasets import load_scene
from msdgs_train.engine.trainer import Trainer
from msdgs_train.gaussians.model import DynamicGaussians
from msdgs_train.gaussians.model_file import SceneInfo, load_model
from msdgs_train.gaussians.modulation import EMBEDDINGS
from msdgs_train.gaussians.scale_space import LOG_SCALE_LIMIT
from msdgs_train.systems.registry import preset
from tests.support.models import MLP, NODES, PLANE, SCENE, SHADING, SPLINE, export_scene, random_model, saved
from tests.support.processes import ROOT
from tests.support.service import serving
from tests.support.splat_files import inria_columns, ply_bytes, some_gaussians
from tests.support.tolerances import tolerance
from tests.support.training_scene import GAUSSIANS, shrunk, write_scene

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def model() -> DynamicGaussians:
    return random_model()


@pytest.fixture(scope="module")
def scene_file(tmp_path_factory: pytest.TempPathFactory, model: DynamicGaussians) -> Path:
    folder = tmp_path_factory.mktemp("scene")
    return export_scene(saved(folder, model), folder / "scene.onnx").path


@pytest.mark.parametrize(
    ("count", "changes", "moving"),
    [
        (300, {}, 300),
        (300, {"layers": (replace(MLP, depth=1),)}, 300),
        (300, {"layers": ("mlp",) * 4, "embedding_dim": 0, "noise": 0.01}, 300),
        (300, {"layers": ("plane",)}, 300),
        (300, {"layers": ("mlp", *[replace(PLANE, time_resolution=2, resolution=2)] * 2)}, 300),
        (1, {"layers": ("plane", "mlp")}, 1),
        (300, {"weights": False, "layers": ("mlp", "plane")}, 300),
        (300, {"modulation_targets": ("means",)}, 300),
        (300, {"modulation_targets": ("quats", "means", "scales"), "layers": ("plane", "mlp")}, 300),
        (300, {"scale_space": "linear", "noise": 0.03}, 300),
        (300, {"layers": (replace(MLP, depth=4, skip=3),) * 2}, 300),
        (300, {"layers": (replace(MLP, time_network=False), "plane")}, 300),
        (300, {"layers": (replace(PLANE, multires=(1, 2), resolution=6),) * 2}, 300),
        (300, {"sh_degree": 0}, 300),
        (300, {"layers": ("mlp", "plane"), "opacity_head": True}, 300),
        (300, {"layers": ("plane", "mlp"), "opacity_head": True, "sh_head": True, "sh_degree": 2}, 300),
        (300, {"layers": ("mlp",), "weights": False, "sh_head": True, "sh_degree": 0}, 300),
        (0, {"opacity_head": True, "sh_head": True}, 0),
        (300, {"support": replace(NODES, num_nodes=12), "layers": (replace(SPLINE, num_knots=5),)}, 300),
        (300, {"support": replace(NODES, num_nodes=3), "layers": ("spline", "plane", "mlp"), "embedding_dim": 0}, 300),
        (300, {"support": NODES, "layers": ("mlp", "mlp"), "modulation_targets": ("quats", "means")}, 300),
        (300, {"support": replace(NODES, num_nodes=9, k_nearest=2), "layers": ("plane",), "weights": False}, 300),
        (300, {"support": replace(NODES, num_nodes=300), "layers": (replace(SPLINE, affine=False), "mlp")}, 300),
        (300, {"support": replace(NODES, num_nodes=9), "layers": ("bodies", "spline", "mlp"), "noise": 0.03}, 300),
        (300, {"support": NODES, "layers": ("mlp", "bodies"), "embedding_dim": 0}, 300),
        (300, {"support": replace(NODES, num_nodes=9), "layers": (SHADING, "mlp"), "embedding_dim": 0}, 300),
        (300, {"support": NODES, "layers": ("mlp", SHADING, SHADING), "sh_degree": 0}, 300),
        (1, {"support": NODES, "layers": ("mlp",)}, 1),
        (0, {"support": NODES, "layers": ("spline",)}, 0),
        (300, {"layers": ()}, 0),
        (1, {}, 1),
        (1, {"layers": ()}, 0),
        (0, {}, 0),
        (0, {"layers": (), "embedding_dim": 0}, 0),
    ],
)
def test_every_kind_of_model_exports(tmp_path: Path, count: int, changes: dict[str, Any], moving: int):
    model = random_model(count, **changes)
    bound = tolerance("export.relative")
    exported = export_scene(saved(tmp_path, model), tmp_path / "scene.onnx", times=4)
    assert (exported.moving_count, exported.static_count) == (moving, count - moving)
    for name in ("means", "quats", "scales"):
        for errors in (exported.measured_error, exported.measured_error["against_float32"]):
            assert errors[name] <= bound
    drawn, posed = DeformationSession(exported.path).gaussians(0.37).validate(), model.pose(0.37)
    assert len(drawn) == count
    for name in posed._fields:
        got, want = getattr(drawn, name), getattr(posed, name).detach().numpy()
        np.testing.assert_allclose(got, want, rtol=0, atol=bound)


@pytest.mark.parametrize(
    ("model", "scene"),
    [
        ("ball/model.pt", "ball/model.onnx"),
        ("v0.5.ply", "v0.5.onnx"),
        ("ball_0.5", "ball_0.5.onnx"),
        ("ball_0.6/", "ball_0.6.onnx"),
        ("ball_0.5/..", "runs.onnx"),
        (".", "runs.onnx"),
    ],
)
def test_a_scene_file_is_written_beside_a_file_or_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, model: str, scene: str
):
    for name in ("ball_0.5", "ball_0.6"):
        (tmp_path / "runs" / name).mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "runs")
    place = tmp_path if scene == "runs.onnx" else tmp_path / "runs"
    assert ExportOptions(Path(model)).scene_file.absolute() == place / scene


@pytest.mark.parametrize("of", ["model", "splats"])
def test_the_seconds_of_a_scene_are_stored_if_they_are_given(tmp_path: Path, of: str):
    file = tmp_path / "frame_1.ply"
    if of == "splats":
        file.write_bytes(ply_bytes(inria_columns(some_gaussians(20))))
    model = saved(tmp_path, random_model(5, layers=())) if of == "model" else file
    options = ExportOptions(model, tmp_path / "scene.onnx", quick=of == "model", duration=2.5, keep=("float32",))
    assert to_onnx(options) == 0
    assert DeformationSession(tmp_path / "scene.onnx").scene.metadata.duration == 2.5
    assert to_onnx(replace(options, duration=0)) == EXIT_INVALID
    with serving(tmp_path / "scene.onnx") as client:
        assert client.get("/scenes/scene").json()["duration"] == 2.5


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scene(tmp_path_factory.mktemp("data") / "scene")


@pytest.mark.parametrize("name", GAUSSIANS)
def test_each_preset_exports(name: str, data: Path, tmp_path: Path):
    trainer = Trainer(shrunk(preset(name)), load_scene(data))
    for _ in range(12):
        trainer.step()
    trainer.system.save(tmp_path / "model.pt", 12)
    exported = export_scene(tmp_path / "model.pt", tmp_path / "scene.onnx", times=5)
    drawn = DeformationSession(exported.path).gaussians(0.37)
    model = load_model(tmp_path / "model.pt").model
    with torch.no_grad():  # unit quaternions for those that are raw in training
        posed = model.pose(0.37)
    expected = {name: getattr(posed, name).detach().numpy() for name in ("means", "quats", "scales")}
    atol = tolerance("export.relative")
    np.testing.assert_allclose(drawn.means, expected["means"], rtol=0, atol=atol)
    if model.config.quat_space == "raw":  # axes of equal length have no direction
        shapes = covariances(expected["quats"], expected["scales"])
        np.testing.assert_allclose(covariances(drawn.quats, drawn.scales), shapes, rtol=0, atol=atol * shapes.max())
    else:
        np.testing.assert_allclose(drawn.quats, expected["quats"], rtol=0, atol=atol)
        np.testing.assert_allclose(drawn.scales, expected["scales"], rtol=0, atol=atol)


def covariances(quats: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """[N, 3, 3] of N Gaussians."""
    axes = to_matrix(quats.astype(np.float64)) * scales[:, None, :]
    return axes @ axes.transpose(0, 2, 1)


def test_images_are_as_wide_as_those_of_the_run(data: Path):
    full, half = (HeldOutImages(data, SceneInfo(size=n), lambda _: lambda: None).training for n in (None, 16))
    assert half[0].width == 16 < full[0].width


def test_images_that_the_run_held_out_are_no_training_images(data: Path):
    counts = [len(HeldOutImages(data, SceneInfo(llffhold=n), lambda _: lambda: None).training) for n in (0, 3)]
    assert counts[1] < counts[0]


@pytest.mark.parametrize(("time_from", "count"), [(None, 1), ("none", 0)])
def test_images_have_the_times_of_the_run(data: Path, time_from: str | None, count: int):
    counts = []

    def begin(count: int) -> Callable[[], None]:
        counts.append(count)
        return lambda: None

    HeldOutImages(data, SceneInfo(time_range=(0.5, 1.0), time_from=time_from), begin)
    assert counts == [count]


def test_embeddings_and_their_network_are_gone(scene_file: Path, model: DynamicGaussians):
    contents = scene_file.read_bytes()

    def stored(tensor: torch.Tensor) -> bool:
        return tensor.detach().numpy().tobytes() in contents

    assert model.modulation is not None
    embeddings = model.gaussians.get_parameter(EMBEDDINGS)
    assert not any(stored(row) for row in embeddings[:20])
    assert not any(stored(parameter) for parameter in model.modulation.parameters())
    assert stored(model.gaussians.means)
    scales = model.modulation(embeddings)["scales"]
    assert scales is not None
    assert stored(scales)
    names = [tensor.name for tensor in onnx.load(scene_file).graph.initializer]
    assert not [name for name in names if "embedding" in name]


def test_metadata(scene_file: Path):
    metadata = DeformationSession(scene_file).scene.metadata
    assert metadata.contract == "msdgs/1"
    assert metadata.layers == ("mlp", "mlp")
    assert (metadata.plan, metadata.delta_space, metadata.antialiasing) == ("network", "raw", "dilate")
    assert (metadata.time_range, metadata.background) == (SCENE.time_range, SCENE.background)
    assert metadata.bounds == ((-1.3,) * 3, (1.3,) * 3)
    assert (metadata.sh_degree, metadata.left_out, metadata.package_version) == (3, (), __version__)
    assert metadata.measured_error["times"] == 50
    assert metadata.checkpoint_sha256 == hashlib.sha256((scene_file.parent / "model.pt").read_bytes()).hexdigest()


@pytest.mark.parametrize(("count", "kept"), [(0, 0), (1, 1), (5, 5), (8, 8), (30, 8)])
def test_a_few_cameras_spread_evenly_are_kept(count: int, kept: int):
    cameras = starting_cameras(SceneInfo(cameras=SCENE.cameras[:count]))
    assert len(cameras) == kept
    if count:
        assert (cameras[0].name, cameras[-1].name) == ("r_000", f"r_{count - 1:03}")


def test_a_file_is_no_larger_than_what_it_stores():
    model = random_model(2000)
    gaussian = 4 * (48 + 1 + 3 + 3 + 4 + 3) + 8  # SH, opacity, mean, log-scale, quaternion, modulation; id
    weights = 4 * sum(p.numel() for p in model.deformation.parameters())
    size = len(build("network", bake(model, SCENE, "0" * 64)).SerializeToString())
    assert 2000 * gaussian + weights < size < 2000 * gaussian + weights + 30_000


def test_times_to_compare_at_hold_both_ends_and_lie_between_frames():
    times = times_to_verify(0.0, 1.0, 50)
    assert len(set(times)) == 50
    assert times == sorted(times)
    assert (times[0], times[-1]) == (0.0, 1.0)
    for frames in (50, 100, 150):
        off = np.array(times[1:-1]) * (frames - 1)
        assert np.abs(off - off.round()).min() > 0
    for alone in (0.25, 0.1):  # 0.1 isn't a float32
        assert set(times_to_verify(alone, alone, 50)) == {alone}


@pytest.mark.parametrize("name", ["gaussians.means", "gaussians.sh_rest", "deformation.layers.1.trunk.0.weight"])
def test_a_file_that_is_not_its_model_is_found_out(scene_file: Path, name: str):
    other = random_model()
    with torch.no_grad():
        other.get_parameter(name).view(-1)[100] += 0.5
    with pytest.raises(VerificationFailed):
        verify(DeformationSession(scene_file), other)


@pytest.mark.parametrize("count", [1, 30])
def test_unstable_gaussians_are_counted_and_compared_in_frames(tmp_path: Path, count: int):
    model = random_model(300, layers=("mlp",))
    heads, raw_quats = model.get_submodule("deformation.layers.0.heads"), model.gaussians.raw_quats
    assert isinstance(heads, torch.nn.Linear)
    with torch.no_grad():
        heads.weight *= 1e-4
        heads.weight[-1] = 0
        heads.bias[:] = torch.tensor([0.0] * 6 + [-2.0, 0, 0, 0] + [0.0])
        raw_quats[:] = torch.tensor([0.0, 1.0, 0.0, 0.0])
        raw_quats[:count] = torch.tensor([1.0, 0.0, 0.0, 0.0])  # its delta, 0.5 × -2, cancels all but the last digits
    checkpoint = saved(tmp_path, model)
    unstable = export_scene(checkpoint, tmp_path / "scene.onnx", times=4).measured_error["unstable"]
    assert unstable["count"] == count
    assert unstable["error"] > tolerance("export.relative")


def interrupt() -> None:
    raise KeyboardInterrupt


@pytest.mark.parametrize(
    ("settings", "error"), [({"tolerance": 0.0}, VerificationFailed), ({"on_time": interrupt}, KeyboardInterrupt)]
)
def test_an_old_file_survives_failures(tmp_path: Path, settings: dict[str, Any], error: type):
    output = tmp_path / "scene.onnx"
    output.write_bytes(b"an older scene")
    checkpoint = saved(tmp_path, random_model())
    with pytest.raises(error):
        export_scene(checkpoint, output, **settings)
    assert output.read_bytes() == b"an older scene"
    assert sorted(tmp_path.iterdir()) == [checkpoint, output]


@pytest.mark.parametrize("layers", [0, 2])
@pytest.mark.parametrize(("log_scale", "limit"), [(200.0, LOG_SCALE_LIMIT), (-200.0, -LOG_SCALE_LIMIT)])
def test_a_scale_that_would_overflow_or_vanish_is_cut(tmp_path: Path, layers: int, log_scale: float, limit: float):
    model = random_model(layers=("mlp",) * layers)
    with torch.no_grad():
        model.gaussians.log_scales[-1] = log_scale
    path = export_scene(saved(tmp_path, model), tmp_path / "scene.onnx").path
    scales = DeformationSession(path).gaussians(0.5).validate().scales
    np.testing.assert_allclose(scales[-1], np.exp(limit), rtol=tolerance("float32.relative"))


@pytest.mark.parametrize(
    ("script", "example", "arguments"),
    [
        ("to_onnx", "msdgs-export runs/", ["nowhere.pt"]), ("stability", "msdgs-stability runs/", ["nowhere.pt"]),
        ("convert", "msdgs-convert ball.onnx", ["nowhere.onnx", "a.ply"]),
    ],
)  # fmt: skip
def test_the_scripts_run_from_any_folder_and_their_help_has_examples(
    tmp_path: Path, script: str, example: str, arguments: list[str]
):
    def run(*arguments: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, str(ROOT / "export" / f"{script}.py"), *arguments]
        return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=600)

    done = run(*arguments)
    assert done.returncode == EXIT_INVALID
    assert f"error: {arguments[0]}" in done.stderr
    shown = run("--help").stdout
    assert example in shown
    assert not [word for word in ("None", "null", "factory") if word in shown]


def test_arrays_that_no_file_holds_are_refused_with_their_size(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr("msdgs_export.layers.graph.MAX_BYTES", 2**14)
    for count, code in ((20, 0), (1000, EXIT_INVALID)):
        (tmp_path / "a.ply").write_bytes(ply_bytes(inria_columns(some_gaussians(count))))
        assert to_onnx(ExportOptions(tmp_path / "a.ply", tmp_path / f"{count}.onnx")) == code
    assert "an ONNX file, which holds at most 2 GiB, got 0.00 GiB of arrays" in capsys.readouterr().err
    assert not (tmp_path / "1000.onnx").exists()


def test_a_folder_is_no_output_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, scene_file: Path):
    def work(*_: object, **__: object) -> None:
        raise AssertionError("it is noticed too late")

    for name in ("jobs.command.Checkpoint.load", "importers.command.read_splats", "importers.command.write_model"):
        monkeypatch.setattr(f"msdgs_export.{name}", work)
    for file_format in ("model", "ply", "deformgs"):
        options = ExportOptions(scene_file.parent / "model.pt", tmp_path, format=file_format)
        with pytest.raises(InvalidInput, match="`output` must be a file, not a folder"):
            export_or_import(options, Console())
    monkeypatch.setattr("msdgs_export.exporters.command.DeformationSession", work)
    for suffix in (".ply", ".onnx", ".usdc"):
        (tmp_path / f"out{suffix}").mkdir()
        with pytest.raises(InvalidInput, match="`out` must be a file, not a folder"):
            convert(ConvertOptions(scene_file, tmp_path / f"out{suffix}"), Console())


def test_what_is_read_is_not_overwritten(tmp_path: Path, scene_file: Path):
    model, scene = tmp_path / "model.pt", tmp_path / "scene.onnx"
    model.write_bytes(b"model")
    scene.write_bytes(scene_file.read_bytes())
    (tmp_path / "link.onnx").symlink_to(model)
    for output in (model, tmp_path / "link.onnx"):
        with pytest.raises(InvalidInput, match="`output` must be another file than the one that is read"):
            export_or_import(ExportOptions(model, output, format="model"), Console())
    with pytest.raises(InvalidInput, match=r"`output` must be named \*\.onnx, got scene"):
        export_or_import(ExportOptions(model, tmp_path / "scene", format="model"), Console())
    with pytest.raises(InvalidInput, match="`out` must be another file"):
        convert(ConvertOptions(scene, tmp_path / "." / scene.name), Console())
    assert stability(model, json=model) == EXIT_INVALID
    assert model.read_bytes() == b"model"
    assert scene.read_bytes() == scene_file.read_bytes()


@pytest.mark.parametrize(
    "value", [{"max_mb": 0.0}, {"tolerance": -1.0}, {"times": 1}, {"plan": "some"}, {"duration": 0.0}]
)
def test_values_are_refused_before_anything_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, value: dict[str, Any]
):
    monkeypatch.setattr("msdgs_export.importers.command.write_model", lambda *_: pytest.fail("it is noticed too late"))
    (name,) = value
    with pytest.raises(InvalidInput, match=f"`{name}` must be"):
        export_or_import(ExportOptions(tmp_path, tmp_path / "a.onnx", "deformgs", **value), Console())


def test_two_arrays_of_one_name_are_refused() -> None:
    graph = GraphBuilder()
    assert graph.constant("sizes", np.arange(3)) == graph.constant("sizes", np.arange(3))
    with pytest.raises(ValueError, match="two constants named sizes"):
        graph.constant("sizes", np.arange(4))

"""Import of runs of Deformable-3D-Gaussians, 4DGaussians and Grid4D; the first two compared with their networks."""

import json
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from rich.console import Console
from scipy.spatial.transform import Rotation
from torch import Tensor

from msdgs_export.bake import bake
from msdgs_export.cli.export import export_or_import
from msdgs_export.cli.to_onnx import main as to_onnx
from msdgs_export.importers.detect import detect_format
from msdgs_export.importers.errors import ImportFailed
from msdgs_export.importers.runs import base
from msdgs_export.importers.runs.fidelity import as_trained
from msdgs_export.importers.runs.model import write_model
from msdgs_export.measure.poses import posed
from msdgs_export.options import ExportOptions
from msdgs_export.plans.registry import build
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.process import EXIT_INVALID
from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.scene.quaternion import to_matrix
from msdgs_train.gaussians.model import DynamicGaussians
from msdgs_train.gaussians.model_file import SceneInfo, load_model
from msdgs_train.layers.hash4d import Hash4DLayer
from msdgs_train.layers.plane import PlaneConfig
from tests.support import foreign_runs as foreign
from tests.support.foreign_runs import COUNT, SWITCHES, State
from tests.support.splat_files import some_gaussians
from tests.support.tolerances import tolerance

QUIET = Console(quiet=True)


@pytest.fixture(autouse=True)
def _networks_are_read_in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not in processes of their own, which first load torch: test_importers_guarded.py is about those."""
    monkeypatch.setattr("msdgs_export.importers.runs.state.read_guarded", lambda read, file: read(file))


def imported(run: Path, kind: str) -> tuple[DynamicGaussians, list[dict[str, Any]]]:
    lost = write_model(run, kind, run.parent / "model.pt", QUIET)
    return load_model(run.parent / "model.pt").model, lost


def check_poses(
    model: DynamicGaussians, t: float, means: Tensor, quats: Tensor, scales: Tensor, unit: Tensor | float = 1.0
) -> None:
    """Compare poses in float64: scales in a unit, and `quats` of any length."""
    with torch.no_grad():
        found = model.double().pose(t)
    quats_error = found.quats - quats / quats.norm(dim=1, keepdim=True)
    for errors in (found.means - means, quats_error, (found.scales - scales) / unit):
        assert errors.abs().max() < tolerance("import.network")


def stored(seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    g = some_gaussians(COUNT, 3, seed)
    means, quats, scales = (torch.from_numpy(array).double() for array in (g.means, g.quats, g.scales))
    return means, quats, scales


@pytest.mark.parametrize("blender", [True, False])
@pytest.mark.parametrize("depth", [4, 8])
def test_the_network_of_deformgs_is_theirs(tmp_path: Path, blender: bool, depth: int):
    state = foreign.deformgs_state(blender, depth)
    run = foreign.write_deformgs(tmp_path / "run", state)
    assert detect_format(run) == "deformgs"
    model, (lost,) = imported(run, "deformgs")
    assert (lost["rule"], lost["count"]) == ("quaternion_fidelity", COUNT)
    assert 10 < lost["worst_frame_db"] < 100
    _, info, step = load_model(tmp_path / "model.pt")
    assert (step, info.background, model.config.scale_space) == (40_000, (1.0, 1.0, 1.0), "linear")
    means, quats, scales = stored(40_000)
    for t in (0.0, 0.37, 1.0):
        d_means, d_quats, d_scales = foreign.deformgs_deltas(state, means.float(), t)
        check_poses(model, t, means + d_means, quats + d_quats, (scales + d_scales).abs())


@pytest.mark.parametrize("lengths", [0.0, 0.5])
@pytest.mark.parametrize("scales", [(1,), (1, 2), (2, 4)])
def test_the_network_of_4dgs_is_theirs(tmp_path: Path, scales: tuple[int, ...], lengths: float):
    state = foreign.fourdgs_state(scales)
    run = foreign.write_fourdgs(tmp_path / "run", state, lengths=lengths)
    assert detect_format(run) == "4dgs"
    model, lost = imported(run, "4dgs")
    assert lost == []
    _, info, step = load_model(tmp_path / "model.pt")
    assert (step, info.background, model.config.scale_space) == (20_000, (1.0, 1.0, 1.0), "log")
    (layer,) = model.config.layers
    assert isinstance(layer, PlaneConfig)
    assert layer.time_resolution == foreign.TIME - (foreign.TIME - 1) // 2
    means, quats, sizes = stored()
    raw_quats = quats * torch.linspace(1 - lengths, 1 + lengths, COUNT, dtype=torch.float64)[:, None]
    for t in (0.0, 0.37, 0.95, 1.0):
        theirs = foreign.fourdgs_deltas(state, means, t)
        quats_error, scaled = raw_quats + theirs["rotations"], sizes * theirs["scales"].exp()
        check_poses(model, t, means + theirs["pos"], quats_error, scaled, unit=sizes)


def test_shapes_are_compared_with_those_that_they_draw(tmp_path: Path):
    state = foreign.deformgs_state(True)
    model, _ = imported(foreign.write_deformgs(tmp_path / "run", state), "deformgs")
    g = some_gaussians(COUNT, 3, seed=40_000)
    drawn, off = as_trained(model, 0.37, posed(model, 0.37))
    _, d_quats, d_scales = (d.numpy() for d in foreign.deformgs_deltas(state, torch.from_numpy(g.means).double(), 0.37))
    quats, scales = g.quats + d_quats, g.scales + d_scales
    squares = np.square(quats).sum(1)[:, None, None]  # the matrix of a quaternion of norm s is I + s² (R - I)
    matrices = (1 - squares) * np.eye(3) + squares * Rotation.from_quat(quats[:, [1, 2, 3, 0]]).as_matrix()
    wanted = matrices @ (np.square(scales)[:, :, None] * matrices.transpose(0, 2, 1))
    axes = to_matrix(drawn.quats.astype(np.float64)) * drawn.scales[:, None, :]
    size = np.abs(wanted).max((1, 2))
    assert (np.abs(axes @ axes.transpose(0, 2, 1) - wanted).max((1, 2)) <= tolerance("import.network") * size).all()
    assert off == pytest.approx(np.abs(np.linalg.norm(quats, axis=1) - 1).max(), rel=tolerance("import.network"))


def test_deltas_that_are_switched_off_are_zero(tmp_path: Path):
    switches = "no_dx=False, no_ds=True, no_dr=True, white_background=False"
    model, _ = imported(foreign.write_fourdgs(tmp_path / "run", foreign.fourdgs_state(), switches), "4dgs")
    with torch.no_grad():
        early, late = model.pose(0.0), model.pose(1.0)
    assert load_model(tmp_path / "model.pt").scene.background == (0.0, 0.0, 0.0)
    assert torch.equal(early.quats, late.quats)
    assert torch.equal(early.scales, late.scales)
    assert not torch.equal(early.means, late.means)


@pytest.mark.parametrize("on", [("no_do",), ("no_dshs",), ("no_do", "no_dshs")])
def test_opacities_and_colors_that_change_are_theirs_and_exported(tmp_path: Path, on: tuple[str, ...]):
    state, means = foreign.fourdgs_state(), stored()[0]
    state["deformation_net.opacity_deform.3.weight"] *= 10  # most Gaussians appear and disappear
    run = foreign.write_fourdgs(tmp_path / "run", state, SWITCHES + "".join(f", {switch}=False" for switch in on))
    model, lost = imported(run, "4dgs")
    assert lost == []
    (tmp_path / "scene.onnx").write_bytes(build("network", bake(model, SceneInfo(), "0" * 64)).SerializeToString())
    session, g = DeformationSession(tmp_path / "scene.onnx"), some_gaussians(COUNT, 3)
    changing = tuple(name for name, switch in (("opacities", "no_do"), ("sh", "no_dshs")) if switch in on)
    assert (session.scene.metadata.contract, session.scene.changing) == ("msdgs/2", changing)
    model = model.double()
    for t in (0.0, 0.37, 0.95, 1.0):
        theirs = foreign.fourdgs_deltas(state, means, t)
        logits = torch.from_numpy(g.opacities).double().logit()
        opacities = (logits + ("no_do" in on) * theirs["opacity"][:, 0]).sigmoid()
        sh = torch.from_numpy(g.sh).double() + ("no_dshs" in on) * theirs["shs"].reshape(COUNT, 16, 3)
        for got in (posed(model, t), session.gaussians(t)):
            assert np.abs(got.opacities - opacities.numpy()).max() < tolerance("import.network")
            assert np.abs(got.sh - sh.numpy()).max() < tolerance("import.network")


def test_a_run_whose_gaussians_fade_is_exported_by_plans_that_run_layers(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    run = foreign.write_fourdgs(
        tmp_path / "run", foreign.fourdgs_state((1,)), SWITCHES + ", no_do=False, no_dshs=False"
    )
    options = ExportOptions(run, tmp_path / "scene.onnx", quick=True, times=3)
    assert to_onnx(options) == 0
    scene = DeformationSession(tmp_path / "scene.onnx").scene
    assert (scene.metadata.layers, scene.changing) == (("plane",), ("opacities", "sh"))
    assert max(scene.metadata.measured_error[name] for name in scene.changing) <= tolerance("export.relative")
    assert to_onnx(replace(options, plan="compact:50")) == EXIT_INVALID
    assert "`plan` must be one that runs layers (network, prefix)" in capsys.readouterr().err


def assert_refused(run: Path, kind: str, message: str):
    with pytest.raises(ImportFailed, match=message):
        write_model(run, kind, run.parent / "model.pt", QUIET)
    assert not (run.parent / "model.pt").exists()


def on_which_device(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return a list to which the device of each new network is added; on `meta` networks take no memory."""
    built: list[str] = []

    def model(*given: Any) -> DynamicGaussians:
        made = DynamicGaussians(*given)
        built.append(next(made.deformation.parameters()).device.type)
        return made

    monkeypatch.setattr(base, "DynamicGaussians", model)
    return built


PLAIN = "isn't a dense tensor of plain numbers"
DEFORMGS_CHANGES: list[tuple[State, str]] = [
    ({"branch_w.weight": torch.zeros(3, 64)}, "is_6dof"),
    ({"linear.3.weight": torch.zeros(64, 7)}, r"`linear.3.weight` has shape \(64, 7\), not 64 × 64"),
    ({"gaussian_warp.bias": torch.full((3,), np.nan)}, r"`gaussian_warp.bias` holds NaN"),
    ({"more": torch.zeros(1).expand(10_000_000, 10_000_000)}, r"`more` .*isn't stored in full: it shares 4 bytes"),
    ({"more": torch.zeros(3, 3).to_sparse()}, rf"`more` .*{PLAIN}"),
    ({"more": torch.zeros(3, dtype=torch.complex64)}, rf"`more` .*{PLAIN}"),
    ({"more": torch.zeros(3, device="meta")}, rf"`more` .*{PLAIN}"),
    ({"more": torch.zeros(3).to(torch.float8_e4m3fn)}, rf"`more` .*{PLAIN}"),
    ({"linear.0.bias": torch.zeros(4_096)}, r"`linear.0.weight` has shape \(64, 93\), not 4096 × 93"),
    ({"linear.0.bias": torch.zeros(50_000)}, r"has 50,000 units a layer"),
    ({"linear.0.bias": torch.zeros(0)}, r"has 0 units a layer"),
    ({"timenet.0.bias": torch.zeros(1)}, r"`timenet.0.bias` has shape \(1,\), not 256"),
    ({"timenet.0.bias": torch.zeros(5)}, r"`timenet.0.bias` has shape \(5,\), not 256"),
    ({"timenet.2.bias": torch.zeros(4_096)}, r"`timenet.2.weight` has shape \(30, 256\), not 4096 × 256"),
    ({"timenet.0.weight": torch.zeros(256, 2_051)}, r"reads 1,025 frequencies of time"),
    ({"linear.0.weight": torch.zeros(64, 2_064)}, r"reads 1,000 frequencies of time"),
]
FOURDGS_CHANGES: list[tuple[State, str]] = [
    ({"feature_out.2.weight": torch.zeros(foreign.WIDTH, foreign.WIDTH)}, r"defor_depth above 1"),
    ({"static_mlp.1.weight": torch.zeros(1)}, r"static_mlp, which no layer"),
    ({"grid.grids.0.3": torch.zeros(1, foreign.CHANNELS, 7, 8)}, r"grids.0.3` has shape \(1, 6, 7, 8\)"),
    ({"grid.aabb": torch.ones(2, 3)}, r"its box is flat"),
    ({"pos_deform.3.bias": torch.full((3,), np.inf)}, r"`deformation_net.pos_deform.3.bias` holds"),
    ({"grid.grids.0.2": torch.ones(1, foreign.CHANNELS, 1, 8)}, r"planes of \[8\] nodes over space and 1"),
    ({"feature_out.0.bias": torch.zeros(4_096)}, r"feature_out.0.weight` has shape \(16, 6\), not 4096 × 6"),
    ({"feature_out.0.bias": torch.zeros(50_000)}, r"has 50,000 units a layer and 1 grids of 6 channels"),
    ({"feature_out.0.bias": torch.zeros(0)}, r"has 0 units a layer"),
    ({"grid.grids.0.2": torch.ones(1, 5_000, 12, 8)}, r"1 grids of 5,000 channels"),
    ({"grid.grids.0.2": torch.ones(1, 6, 12, 4_096)}, r"grids.0.0` has shape \(1, 6, 8, 8\), not 1 × 6 × 4096"),
]


@pytest.mark.parametrize(
    ("kind", "change", "message"),
    [("deformgs", *each) for each in DEFORMGS_CHANGES] + [("4dgs", *each) for each in FOURDGS_CHANGES],
)
def test_a_network_that_differs_is_named_before_memory_is_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, change: State, message: str
):
    if kind == "deformgs":
        run = foreign.write_deformgs(tmp_path / "run", foreign.deformgs_state("linear.0.weight" not in change) | change)
    else:
        changed = {f"deformation_net.{name}": tensor for name, tensor in change.items()}
        run = foreign.write_fourdgs(tmp_path / "run", foreign.fourdgs_state((1,)) | changed)
    built = on_which_device(monkeypatch)
    assert_refused(run, kind, message)
    assert set(built) <= {"meta"}


GRID4D_CHANGES: list[tuple[int, State, str]] = [
    (0, {"xyz_encoding.offsets": torch.tensor([0, 64, 320, 577])}, "`0.xyz_encoding.offsets` aren't those of levels"),
    (0, {"yzt_encoding.offsets": torch.tensor([0, 48])}, r"`0.yzt_encoding.offsets` has shape \(2,\), not 3"),
    (0, {"xyt_encoding.offsets": torch.zeros(1)}, r"`0.xyt_encoding.offsets` has 1 rows, of two levels or more"),
    (0, {"xyz_encoding.per_level_scale": torch.full((3,), 1e9)}, r"`0.xyz_encoding.per_level_scale` gives"),
    (0, {"xyz_encoding.base_resolution": torch.ones(3)}, r"`model.layers.0.canonical_coarsest` must be"),
    (0, {"xyz_encoding.embeddings": torch.zeros(9, 2)}, r"`0.xyz_encoding.embeddings` has shape \(9, 2\)"),
    (1, {"spatial_mlp.0.bias": torch.zeros(50_000)}, r"`model.layers.0.width` must be at most 4,096"),
    (1, {"gaussian_warp.weight": torch.zeros(3, 12)}, r"`1.gaussian_warp.weight` has shape \(3, 12\), not 7 × 12"),
    (1, {"grid_mlp.2.weight": torch.zeros(12, 12)}, r"lacks `1.grid_mlp.2.bias`"),
]


@pytest.mark.parametrize(("part", "change", "message"), GRID4D_CHANGES)
def test_a_network_of_grid4d_that_differs_is_named_before_memory_is_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, part: int, change: State, message: str
):
    states = foreign.grid4d_states()
    states[part] |= change
    built = on_which_device(monkeypatch)
    assert_refused(foreign.write_grid4d(tmp_path / "run", states), "grid4d", message)
    assert set(built) <= {"meta"}


@pytest.mark.parametrize(
    ("settings", "half_sizes"),
    [
        ("grid_args={'bound': 2.0, 'levels': 3}, scale_xyz=[1.0, 0.5, 2.0]", [2.0, 4.0, 1.0]),
        ("grid_args={'bound': 3}, network_args={'depth': 1, 'directional': True}", [3.0, 3.0, 3.0]),
        ("white_background=True", [1.6, 1.6, 1.6]),
    ],
)
def test_the_box_of_grid4d_is_that_of_its_settings(tmp_path: Path, settings: str, half_sizes: list[float]):
    run = foreign.write_grid4d(tmp_path / "run", foreign.grid4d_states(), settings)
    model, (lost,) = imported(run, "grid4d")
    assert (lost["rule"], lost["count"]) == ("quaternion_fidelity", COUNT)
    layer = model.deformation.layers[0]
    assert isinstance(layer, Hash4DLayer)
    assert layer.half_sizes.tolist() == pytest.approx(half_sizes)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ("network_args={'directional': False}", "directional=False"),
        ("grid_args={'bound': 'wide'}", "bound='wide' and scale_xyz=1.0, not positive numbers"),
        ("scale_xyz=[1.0, 2.0]", r"scale_xyz=\[1.0, 2.0\], not positive numbers"),
    ],
)
def test_settings_of_grid4d_that_make_another_network_are_named(tmp_path: Path, settings: str, message: str):
    assert_refused(foreign.write_grid4d(tmp_path / "run", foreign.grid4d_states(), settings), "grid4d", message)


def test_switches_that_make_another_network_are_named(tmp_path: Path):
    run = foreign.write_fourdgs(tmp_path / "run", foreign.fourdgs_state((1,)), SWITCHES + ", apply_rotation=True")
    assert_refused(run, "4dgs", r"apply_rotation")


@pytest.mark.parametrize(
    "contents",
    [
        "[" * 100_000,
        json.dumps([foreign.stored_camera(0) | {"width": float("inf")}]),
        json.dumps([foreign.stored_camera(0) | {"height": 10**400}]),
        json.dumps([foreign.stored_camera(0) | {"fx": 10**400}]),
        "{}",
    ],
    ids=["deep", "infinite", "huge", "huge fx", "no list"],
)
def test_cameras_that_cannot_be_are_refused_by_the_name_of_their_file(tmp_path: Path, contents: str):
    run = foreign.write_fourdgs(tmp_path / "run", foreign.fourdgs_state((1,)))
    (run / "cameras.json").write_text(contents)
    assert_refused(run, "4dgs", r"cameras.json: isn't a list of cameras")


@pytest.mark.parametrize("has_cameras", [True, False])
def test_the_width_of_images_is_that_of_the_runs_cameras(tmp_path: Path, has_cameras: bool):
    run = foreign.write_fourdgs(tmp_path / "run", foreign.fourdgs_state((1,)))
    if not has_cameras:
        (run / "cameras.json").unlink()
    imported(run, "4dgs")
    size = load_model(tmp_path / "model.pt").scene.size
    assert size == (foreign.stored_camera(0)["width"] if has_cameras else None)


def test_images_of_another_world_are_refused(tmp_path: Path):
    run = foreign.write_fourdgs(tmp_path / "run", foreign.fourdgs_state((1,)))
    (tmp_path / "dataset.json").write_text("{}")
    with pytest.raises(InvalidInput, match="unscaled coordinates"):
        export_or_import(ExportOptions(run, data=tmp_path), QUIET)


def network_of(run: Path) -> Path:
    return run / "deform" / "iteration_40000" / "deform.pth"


def test_a_run_without_a_network_is_refused(tmp_path: Path):
    run = foreign.write_deformgs(tmp_path / "run", foreign.deformgs_state(True))
    network_of(run).unlink()
    assert_refused(run, "deformgs", r"no deform/iteration_40000/deform.pth")


def test_states_that_cannot_be_used_are_refused_by_the_runs_name(tmp_path: Path):
    state = foreign.deformgs_state(True)
    long = {  # poses are valid, since rotations are normalized, but shapes overflow
        "gaussian_rotation.bias": torch.full((4,), 1e18),
        "gaussian_scaling.bias": torch.full((3,), 1e5),
    }
    two_layers = foreign.deformgs_state(True, depth=2)  # whose heads read the input again
    for name, changed, message in (
        ("long", state | long, r"long.*its network gives Gaussians that can't be used: `gaussians.scales`"),
        ("two", two_layers, r"has 2 hidden layers; from 3 to 64"),
        ("shared", state | {"linear.3.weight": state["linear.2.weight"]}, r"`linear.3.weight` .*isn't stored in full"),
    ):
        assert_refused(foreign.write_deformgs(tmp_path / name, changed), "deformgs", message)


def test_a_checkpoint_that_unpacks_to_more_than_itself_is_refused(tmp_path: Path):
    run = foreign.write_deformgs(tmp_path / "run", {"linear.0.weight": torch.zeros(1_000_000)})
    with zipfile.ZipFile(network_of(run)) as whole:
        parts = {name: whole.read(name) for name in whole.namelist()}
    with zipfile.ZipFile(network_of(run), "w", zipfile.ZIP_DEFLATED) as packed:
        for name, contents in parts.items():
            packed.writestr(name, contents)
    assert_refused(run, "deformgs", r"is packed: it holds 4,\d{3},\d{3} bytes")

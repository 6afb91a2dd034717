"""Import of 4DGaussians runs, compared with their network, which is written here with grid_sample."""

import itertools
import json
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from export.importers.detect import detect_format
from export.importers.runs.model import write_model
from export.jobs.write import properties
from export.options import ExportOptions
from export.to_onnx import main as to_onnx
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.scene.camera import orbit
from msdgs_train.gaussians.model_file import load_model
from msdgs_train.layers.plane import PlaneConfig
from tests.export.test_importers_runs import QUIET, assert_refused, on_which_device
from tests.support.splat_files import inria_columns, ply_bytes, some_gaussians
from tests.support.tolerances import tolerance

COUNT, SPACE, TIME, CHANNELS, WIDTH = 50, 8, 12, 6, 16
HEADS = {"pos": 3, "scales": 3, "rotations": 4, "opacity": 1, "shs": 48}
SWITCHES = "no_dx=False, no_ds=False, no_dr=False"
BOX = [[1.1, 0.9, 1.4], [-0.8, -1.3, -0.9]]


def their_state(scales: tuple[int, ...] = (1, 2)) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(0)
    state: dict[str, Tensor] = {"deformation_net.grid.aabb": torch.tensor(BOX), "time_poc": torch.ones(4)}

    def linear(name: str, inputs: int, outputs: int, size: float = 1.0) -> None:
        state[f"deformation_net.{name}.weight"] = size * torch.randn(outputs, inputs, generator=generator) / inputs**0.5
        state[f"deformation_net.{name}.bias"] = 0.1 * size * torch.randn(outputs, generator=generator)

    for i, scale in enumerate(scales):
        nodes = [SPACE * scale] * 3 + [TIME]
        for j, (a, b) in enumerate(itertools.combinations(range(4), 2)):
            plane = 0.3 + torch.rand(1, CHANNELS, nodes[b], nodes[a], generator=generator)
            state[f"deformation_net.grid.grids.{i}.{j}"] = plane
    linear("feature_out.0", CHANNELS * len(scales), WIDTH)
    for name, size in HEADS.items():
        linear(f"{name}_deform.1", WIDTH, WIDTH)
        linear(f"{name}_deform.3", WIDTH, size, 0.2)
    return state


def their_deltas(state: dict[str, Tensor], x: Tensor, t: float) -> dict[str, Tensor]:
    """Return the outputs of all heads of their network at positions [N, 3], in float64."""
    s = {name.removeprefix("deformation_net."): tensor.double() for name, tensor in state.items()}
    box = s["grid.aabb"]
    inside = (x.double() - box[0]) * (2 / (box[1] - box[0])) - 1
    point = torch.cat([inside, torch.full((len(x), 1), t, dtype=torch.float64)], dim=1)
    features = []
    for i in range(sum(name.endswith(".5") for name in s)):
        product = torch.ones(())
        for j, axes in enumerate(itertools.combinations(range(4), 2)):
            plane, at = s[f"grid.grids.{i}.{j}"], point[:, list(axes)].reshape(1, 1, -1, 2)
            product = product * F.grid_sample(plane, at, align_corners=True, padding_mode="border")[0, :, 0].T
        features.append(product)

    def linear(name: str, value: Tensor) -> Tensor:
        return value @ s[f"{name}.weight"].T + s[f"{name}.bias"]

    hidden = linear("feature_out.0", torch.cat(features, dim=1)).relu()
    return {name: linear(f"{name}_deform.3", linear(f"{name}_deform.1", hidden).relu()) for name in HEADS}


def write_run(folder: Path, state: dict[str, Tensor], switches: str = SWITCHES, lengths: float = 0.5) -> Path:
    """Write a run whose quaternions have norms from 1 − `lengths` to 1 + `lengths`."""
    cloud = folder / "point_cloud" / "iteration_20000"
    cloud.mkdir(parents=True)
    columns = inria_columns(some_gaussians(COUNT, 3))
    for i in range(4):
        columns[f"rot_{i}"] = columns[f"rot_{i}"] * np.linspace(1 - lengths, 1 + lengths, COUNT).astype(np.float32)
    (cloud / "point_cloud.ply").write_bytes(ply_bytes(columns))
    torch.save(state, cloud / "deformation.pth")
    torch.save(torch.ones(COUNT, dtype=torch.bool), cloud / "deformation_table.pth")
    torch.save(torch.zeros(COUNT, 3), cloud / "deformation_accum.pth")
    config = "{'resolution': [8, 8, 8, 12]}"
    (folder / "cfg_args").write_text(f"Namespace(sh_degree=3, kplanes_config={config}, {switches})")
    (folder / "cameras.json").write_text(json.dumps([camera(turn) for turn in range(4)]))
    return folder


def camera(turn: int) -> dict[str, object]:
    pose = orbit(np.zeros(3), 4.0, 90 * turn, 10, np.array([0.0, -1.0, 0.0]))
    size = {"width": 96, "height": 96, "fx": 96.0, "fy": 96.0}
    return {"img_name": f"{turn}", "rotation": pose[:3, :3].tolist(), "position": pose[:3, 3].tolist(), **size}


@pytest.mark.parametrize("lengths", [0.0, 0.5])
@pytest.mark.parametrize("scales", [(1,), (1, 2), (2, 4)])
def test_the_network_is_theirs(tmp_path: Path, scales: tuple[int, ...], lengths: float):
    state = their_state(scales)
    run = write_run(tmp_path / "run", state, lengths=lengths)
    assert detect_format(run) == "4dgs"
    assert write_model(run, "4dgs", tmp_path / "model.pt", QUIET) == []
    model, info, step = load_model(tmp_path / "model.pt")
    assert (step, info.background, model.config.scale_space) == (20_000, (1.0, 1.0, 1.0), "log")
    (layer,) = model.config.layers
    assert isinstance(layer, PlaneConfig)
    assert layer.time_resolution == TIME - (TIME - 1) // 2
    g = some_gaussians(COUNT, 3)
    means, quats, scales_then = (torch.from_numpy(a).double() for a in (g.means, g.quats, g.scales))
    raw_quats = quats * torch.linspace(1 - lengths, 1 + lengths, COUNT, dtype=torch.float64)[:, None]
    for t in (0.0, 0.37, 0.95, 1.0):
        theirs = their_deltas(state, means, t)
        with torch.no_grad():
            posed = model.double().pose(t)
        assert (posed.means - means - theirs["pos"]).abs().max() < tolerance("import.network")
        assert (posed.scales / scales_then - theirs["scales"].exp()).abs().max() < tolerance("import.network")
        turned = raw_quats + theirs["rotations"]
        assert (posed.quats - turned / turned.norm(dim=1, keepdim=True)).abs().max() < tolerance("import.network")


def test_deltas_that_are_switched_off_are_zero(tmp_path: Path):
    run = write_run(tmp_path / "run", their_state(), "no_dx=False, no_ds=True, no_dr=True, white_background=False")
    write_model(run, "4dgs", tmp_path / "model.pt", QUIET)
    model, info, _ = load_model(tmp_path / "model.pt")
    with torch.no_grad():
        early, late = model.pose(0.0), model.pose(1.0)
    assert info.background == (0.0, 0.0, 0.0)
    assert torch.equal(early.quats, late.quats)
    assert torch.equal(early.scales, late.scales)
    assert not torch.equal(early.means, late.means)


def test_changing_opacities_and_colors_are_held_and_the_cost_is_said(tmp_path: Path):
    state = their_state()
    run = write_run(tmp_path / "run", state, SWITCHES + ", no_do=False, no_dshs=False")
    (lost,) = write_model(run, "4dgs", tmp_path / "model.pt", QUIET)
    model = load_model(tmp_path / "model.pt").model
    g = some_gaussians(COUNT, 3)
    means, logits = torch.from_numpy(g.means), torch.from_numpy(g.opacities).double().logit()
    theirs = [their_deltas(state, means, float(t)) for t in np.linspace(0, 1, 401)]
    opacities = torch.stack([(logits + d["opacity"][:, 0]).sigmoid() for d in theirs])
    with torch.no_grad():
        held = model.pose(0.5)
    assert (held.opacities - opacities.mean(dim=0)).abs().max() < tolerance("import.mean_over_time")
    sh = torch.stack([torch.from_numpy(g.sh).double() + d["shs"].reshape(COUNT, 16, 3) for d in theirs])
    mean = (opacities[..., None, None] * sh).sum(dim=0) / opacities.sum(dim=0)[:, None, None]
    assert (held.sh - mean).abs().max() < tolerance("import.mean_over_time")
    assert lost["count"] == COUNT
    for plane in (2, 4, 5):  # most Gaussians come and go
        state[f"deformation_net.grid.grids.0.{plane}"] *= torch.linspace(0, 1.5, TIME)[:, None]
    state["deformation_net.opacity_deform.3.weight"] *= 300
    (more,) = write_model(
        write_run(tmp_path / "more", state, SWITCHES + ", no_do=False"), "4dgs", tmp_path / "m", QUIET
    )
    assert more["worst_frame_db"] < min(lost["worst_frame_db"], 40)


def test_a_run_is_exported_and_lists_what_is_held(tmp_path: Path):
    run = write_run(tmp_path / "run", their_state((1,)), SWITCHES + ", no_do=False, no_dshs=True")
    assert to_onnx(ExportOptions(run, tmp_path / "scene.onnx", quick=True, times=3)) == 0
    scene = DeformationSession(tmp_path / "scene.onnx")
    assert scene.scene.metadata.layers == ("plane",)
    (held,) = (
        each
        for each in properties(onnx.load(tmp_path / "scene.onnx"))["left_out"]
        if each["rule"] == "static_appearance"
    )
    assert "opacities and colors" in held["what"]


UNIMPORTABLE = [
    ({"feature_out.2.weight": torch.zeros(WIDTH, WIDTH)}, r"defor_depth above 1"),
    ({"static_mlp.1.weight": torch.zeros(1)}, r"static_mlp, which no layer"),
    ({"grid.grids.0.3": torch.zeros(1, CHANNELS, 7, 8)}, r"grids.0.3` has shape \(1, 6, 7, 8\)"),
    ({"grid.aabb": torch.ones(2, 3)}, r"its box is flat"),
    ({"pos_deform.3.bias": torch.full((3,), np.inf)}, r"`deformation_net.pos_deform.3.bias` holds"),
    ({"grid.grids.0.2": torch.ones(1, CHANNELS, 1, 8)}, r"planes of \[8\] nodes over space and 1"),
    ({"feature_out.0.bias": torch.zeros(4_096)}, r"feature_out.0.weight` has shape \(16, 6\), not 4096 × 6"),
    ({"feature_out.0.bias": torch.zeros(50_000)}, r"has 50,000 units a layer and 1 grids of 6 channels"),
    ({"feature_out.0.bias": torch.zeros(0)}, r"has 0 units a layer"),
    ({"grid.grids.0.2": torch.ones(1, 5_000, 12, 8)}, r"1 grids of 5,000 channels"),
    ({"grid.grids.0.2": torch.ones(1, 6, 12, 4_096)}, r"grids.0.0` has shape \(1, 6, 8, 8\), not 1 × 6 × 4096"),
]


@pytest.mark.parametrize(("change", "message"), UNIMPORTABLE)
def test_a_network_that_differs_is_named_before_memory_is_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: dict[str, Tensor], message: str
):
    changed = {f"deformation_net.{name}": tensor for name, tensor in change.items()}
    run, built = write_run(tmp_path / "run", their_state((1,)) | changed), on_which_device(monkeypatch)
    assert_refused(run, "4dgs", message)
    assert set(built) <= {"meta"}


def test_switches_that_make_another_network_are_named(tmp_path: Path):
    run = write_run(tmp_path / "run", their_state((1,)), SWITCHES + ", apply_rotation=True")
    assert_refused(run, "4dgs", r"apply_rotation")


@pytest.mark.parametrize(
    "contents",
    [
        "[" * 100_000,
        json.dumps([camera(0) | {"width": float("inf")}]),
        json.dumps([camera(0) | {"height": 10**400}]),
        json.dumps([camera(0) | {"fx": 10**400}]),
        "{}",
    ],
    ids=["deep", "infinite", "huge", "huge fx", "no list"],
)
def test_cameras_that_cannot_be_are_refused_by_the_name_of_their_file(tmp_path: Path, contents: str):
    run = write_run(tmp_path / "run", their_state((1,)))
    (run / "cameras.json").write_text(contents)
    assert_refused(run, "4dgs", r"cameras.json: isn't a list of cameras")

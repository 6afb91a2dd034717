"""Import of Deformable-3D-Gaussians runs, compared with their network, which is written here in a few lines."""

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from rich.console import Console
from scipy.spatial.transform import Rotation
from torch import Tensor

from export.importers.detect import detect_format
from export.importers.errors import ImportFailed
from export.importers.runs import base
from export.importers.runs.fidelity import as_trained
from export.importers.runs.model import write_model
from export.measure.poses import posed
from msdgs_serve.scene.quaternion import to_matrix
from msdgs_train.gaussians.model import DynamicGaussians
from msdgs_train.gaussians.model_file import load_model
from tests.support.splat_files import inria_columns, ply_bytes, some_gaussians
from tests.support.tolerances import tolerance

QUIET = Console(quiet=True)
COUNT = 50


def encode(x: Tensor, frequencies: int) -> Tensor:
    parts = [x]
    for k in range(frequencies):
        parts += [torch.sin(2.0**k * x), torch.cos(2.0**k * x)]
    return torch.cat(parts, dim=-1)


def their_state(blender: bool, depth: int = 8, width: int = 64) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(0)
    state: dict[str, Tensor] = {}

    def linear(name: str, inputs: int, outputs: int, size: float = 1.0) -> None:
        state[f"{name}.weight"] = size * torch.randn(outputs, inputs, generator=generator) / inputs**0.5
        state[f"{name}.bias"] = 0.1 * size * torch.randn(outputs, generator=generator)

    if blender:
        linear("timenet.0", 13, 256)
        linear("timenet.2", 256, 30)
    inputs = 63 + (30 if blender else 21)
    for i in range(depth):
        linear(f"linear.{i}", inputs if i == 0 else width + inputs if i == depth // 2 + 1 else width, width)
    for name, size in (("gaussian_warp", 3), ("gaussian_scaling", 3), ("gaussian_rotation", 4)):
        linear(name, width, size, 0.1)
    return state


def their_deltas(state: dict[str, Tensor], x: Tensor, t: float) -> tuple[Tensor, Tensor, Tensor]:
    """Return the deltas of positions, rotations and scales by their network in float64."""
    s = {name: tensor.double() for name, tensor in state.items()}

    def linear(name: str, value: Tensor) -> Tensor:
        return value @ s[f"{name}.weight"].T + s[f"{name}.bias"]

    blender = "timenet.0.weight" in s
    time = encode(torch.full((len(x), 1), t, dtype=torch.float64), 6 if blender else 10)
    if blender:
        time = linear("timenet.2", linear("timenet.0", time).relu())
    given = torch.cat([encode(x.double(), 10), time], dim=-1)
    depth, hidden = sum(n.startswith("linear.") and n.endswith("bias") for n in s), given
    for i in range(depth):
        hidden = linear(f"linear.{i}", hidden).relu()
        if i == depth // 2:
            hidden = torch.cat([given, hidden], dim=-1)
    return linear("gaussian_warp", hidden), linear("gaussian_rotation", hidden), linear("gaussian_scaling", hidden)


def write_run(folder: Path, state: dict[str, Tensor]) -> Path:
    for iteration in (7_000, 40_000):
        cloud = folder / "point_cloud" / f"iteration_{iteration}" / "point_cloud.ply"
        network = folder / "deform" / f"iteration_{iteration}" / "deform.pth"
        cloud.parent.mkdir(parents=True)
        network.parent.mkdir(parents=True)
        cloud.write_bytes(ply_bytes(inria_columns(some_gaussians(COUNT, 3, seed=iteration))))
        torch.save(state, network)
    (folder / "cfg_args").write_text("Namespace(sh_degree=3, white_background=True, source_path=open('x'))")
    return folder


@pytest.mark.parametrize("blender", [True, False])
@pytest.mark.parametrize("depth", [4, 8])
def test_the_network_is_theirs(tmp_path: Path, blender: bool, depth: int):
    state = their_state(blender, depth)
    run = write_run(tmp_path / "run", state)
    assert detect_format(run) == "deformgs"
    (lost,) = write_model(run, "deformgs", tmp_path / "model.pt", QUIET)
    assert (lost["rule"], lost["count"]) == ("quaternion_fidelity", COUNT)
    assert 10 < lost["worst_frame_db"] < 100
    model, info, step = load_model(tmp_path / "model.pt")
    g = some_gaussians(COUNT, 3, seed=40_000)
    assert (step, info.background, model.config.scale_space) == (40_000, (1.0, 1.0, 1.0), "linear")
    means, quats, scales = (torch.from_numpy(a).double() for a in (g.means, g.quats, g.scales))
    for t in (0.0, 0.37, 1.0):
        d_means, d_quats, d_scales = their_deltas(state, means, t)
        with torch.no_grad():
            posed = model.double().pose(t)
        assert (posed.means - means - d_means).abs().max() < tolerance("import.network")
        assert (posed.scales - (scales + d_scales).clamp_min(2.1e-9)).abs().max() < tolerance("import.network")
        theirs = quats + d_quats
        assert (posed.quats - theirs / theirs.norm(dim=1, keepdim=True)).abs().max() < tolerance("import.network")


def test_shapes_are_compared_with_those_that_they_draw(tmp_path: Path):
    state = their_state(True)
    write_model(write_run(tmp_path / "run", state), "deformgs", tmp_path / "model.pt", QUIET)
    model, g = load_model(tmp_path / "model.pt").model, some_gaussians(COUNT, 3, seed=40_000)
    drawn, off = as_trained(model, 0.37, posed(model, 0.37))
    _, d_quats, d_scales = (d.numpy() for d in their_deltas(state, torch.from_numpy(g.means).double(), 0.37))
    quats, scales = g.quats + d_quats, g.scales + d_scales
    squares = np.square(quats).sum(1)[:, None, None]  # a matrix of a length s is I + s² (R - I)
    matrices = (1 - squares) * np.eye(3) + squares * Rotation.from_quat(quats[:, [1, 2, 3, 0]]).as_matrix()
    wanted = matrices @ (np.square(scales)[:, :, None] * matrices.transpose(0, 2, 1))
    axes = to_matrix(drawn.quats.astype(np.float64)) * drawn.scales[:, None, :]
    size = np.abs(wanted).max((1, 2))
    assert (np.abs(axes @ axes.transpose(0, 2, 1) - wanted).max((1, 2)) <= tolerance("import.network") * size).all()
    assert off == pytest.approx(np.abs(np.linalg.norm(quats, axis=1) - 1).max(), rel=tolerance("import.network"))


def assert_refused(run: Path, kind: str, message: str):
    with pytest.raises(ImportFailed, match=message):
        write_model(run, kind, run.parent / "model.pt", QUIET)
    assert not (run.parent / "model.pt").exists()


def network_of(run: Path) -> Path:
    return run / "deform" / "iteration_40000" / "deform.pth"


PLAIN = "isn't a dense tensor of plain numbers"
UNIMPORTABLE = [
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


@pytest.mark.parametrize(("change", "message"), UNIMPORTABLE)
def test_a_network_that_differs_is_named_before_memory_is_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: dict[str, Tensor], message: str
):
    of_blender = "linear.0.weight" not in change
    run, built = write_run(tmp_path / "run", their_state(of_blender) | change), on_which_device(monkeypatch)
    assert_refused(run, "deformgs", message)
    assert set(built) <= {"meta"}


def test_a_run_without_a_network_is_refused(tmp_path: Path):
    run = write_run(tmp_path / "run", their_state(True))
    network_of(run).unlink()
    assert_refused(run, "deformgs", r"no deform/iteration_40000/deform.pth")


def test_rotations_so_long_that_shapes_overflow_are_refused_by_the_runs_name(tmp_path: Path):
    state = their_state(True)
    state["gaussian_rotation.bias"] = torch.full((4,), 1e18)  # poses are sound: rotations are made unit
    state["gaussian_scaling.bias"] = torch.full((3,), 1e5)
    message = r"run.*its network gives Gaussians that can't be used: `gaussians.scales`"
    assert_refused(write_run(tmp_path / "run", state), "deformgs", message)


def test_two_layers_whose_heads_read_the_input_again_are_refused(tmp_path: Path):
    run = write_run(tmp_path / "run", their_state(True, depth=2))
    assert_refused(run, "deformgs", r"has 2 hidden layers; from 3 to 64")


def test_a_storage_is_no_two_tensors(tmp_path: Path):
    state = their_state(True)
    run = write_run(tmp_path / "run", state | {"linear.3.weight": state["linear.2.weight"]})
    assert_refused(run, "deformgs", r"`linear.3.weight` .*isn't stored in full")


def test_a_checkpoint_that_unpacks_to_more_than_itself_is_refused(tmp_path: Path):
    run = write_run(tmp_path / "run", {"linear.0.weight": torch.zeros(1_000_000)})
    with zipfile.ZipFile(network_of(run)) as whole:
        parts = {name: whole.read(name) for name in whole.namelist()}
    with zipfile.ZipFile(network_of(run), "w", zipfile.ZIP_DEFLATED) as packed:
        for name, contents in parts.items():
            packed.writestr(name, contents)
    assert_refused(run, "deformgs", r"is packed: it holds 4,\d{3},\d{3} bytes")


def on_which_device(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return a list of the devices on which networks are made from now on; on `meta` they take no memory."""
    built: list[str] = []

    def model(*given: Any) -> DynamicGaussians:
        made = DynamicGaussians(*given)
        built.append(next(made.deformation.parameters()).device.type)
        return made

    monkeypatch.setattr(base, "DynamicGaussians", model)
    return built


class Evil:
    """Runs code when unpickled."""

    def __reduce__(self) -> tuple:
        return Path.touch, (Path("ran"),)


def test_no_code_in_a_checkpoint_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    run = write_run(tmp_path / "run", their_state(True))
    torch.save({"linear.0.weight": Evil()}, network_of(run))
    assert_refused(run, "deformgs", r"isn't a whole torch checkpoint of plain values")
    assert not (tmp_path / "ran").exists()

"""Runs of Deformable-3D-Gaussians: their network, said again here in a few lines, and what becomes of it."""

from pathlib import Path

import numpy as np
import pytest
import torch
from rich.console import Console
from torch import Tensor

from export.importers import ImportFailed, recognise
from export.importers.runs import write_model
from msdgs_train.checkpoint import load_model
from tests.splat_files import inria_columns, ply_bytes, some_gaussians
from tests.tolerances import tolerance

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
    """Their network in float64: deltas of positions, rotations and scales."""
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
    assert recognise(run) == "deformgs"
    assert write_model(run, "deformgs", tmp_path / "model.pt", QUIET) == []
    model, info, step = load_model(tmp_path / "model.pt")
    g = some_gaussians(COUNT, 3, seed=40_000)
    assert (step, info.background, model.config.delta_space) == (40_000, (1.0, 1.0, 1.0), "activated")
    means, quats, scales = (torch.from_numpy(a).double() for a in (g.means, g.quats, g.scales))
    for t in (0.0, 0.37, 1.0):
        d_means, d_quats, d_scales = their_deltas(state, means, t)
        with torch.no_grad():
            posed = model.double().pose(t)
        assert (posed.means - means - d_means).abs().max() < tolerance("import.network")
        assert (posed.scales - (scales + d_scales).clamp_min(2.1e-9)).abs().max() < tolerance("import.network")
        theirs = quats + d_quats
        assert (posed.quats - theirs / theirs.norm(dim=1, keepdim=True)).abs().max() < tolerance("import.network")


def test_what_differs_is_named(tmp_path: Path):
    state = their_state(True)
    run = write_run(tmp_path / "run", state)
    network = run / "deform" / "iteration_40000" / "deform.pth"
    broken = {
        "branch_w.weight": (torch.zeros(3, 64), "is_6dof"),
        "linear.3.weight": (torch.zeros(64, 7), r"`linear.3.weight` has shape \(64, 7\), not 64 × 64"),
        "gaussian_warp.bias": (torch.full((3,), np.nan), r"`gaussian_warp.bias` holds NaN"),
    }
    for name, (tensor, message) in broken.items():
        torch.save({**state, name: tensor}, network)
        with pytest.raises(ImportFailed, match=message):
            write_model(run, "deformgs", tmp_path / "model.pt", QUIET)
    network.unlink()
    with pytest.raises(ImportFailed, match=r"no deform/iteration_40000/deform.pth"):
        write_model(run, "deformgs", tmp_path / "model.pt", QUIET)


class Evil:
    """Runs code when unpickled."""

    def __reduce__(self) -> tuple:
        return Path.touch, (Path("ran"),)


def test_no_code_in_a_checkpoint_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    run = write_run(tmp_path / "run", their_state(True))
    torch.save({"linear.0.weight": Evil()}, run / "deform" / "iteration_40000" / "deform.pth")
    with pytest.raises(ImportFailed, match=r"isn't a whole torch checkpoint of plain values"):
        write_model(run, "deformgs", tmp_path / "model.pt", QUIET)
    assert not (tmp_path / "ran").exists()

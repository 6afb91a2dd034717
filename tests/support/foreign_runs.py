"""Runs of Deformable-3D-Gaussians, 4DGaussians and Grid4D with small random networks, reimplemented in a few lines."""

import itertools
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from msdgs_serve.scene.camera import orbit
from msdgs_train.layers.hash_kernels import Levels
from tests.support.splat_files import inria_columns, ply_bytes, some_gaussians

COUNT = 50
State = dict[str, Tensor]

SPACE, TIME, CHANNELS, WIDTH = 8, 12, 6, 16
"""Sizes of the planes and layers of 4DGaussians."""

HEADS = {"pos": 3, "scales": 3, "rotations": 4, "opacity": 1, "shs": 48}
SWITCHES = "no_dx=False, no_ds=False, no_dr=False"
BOX = [[1.1, 0.9, 1.4], [-0.8, -1.3, -0.9]]


def _random_layers(state: State, prefix: str = "") -> tuple[Callable[..., None], torch.Generator]:
    """Return a function that adds a random linear layer to a state, and its generator."""
    generator = torch.Generator().manual_seed(0)

    def add(name: str, inputs: int, outputs: int, size: float = 1.0) -> None:
        weight = size * torch.randn(outputs, inputs, generator=generator) / inputs**0.5
        state[f"{prefix}{name}.weight"] = weight
        state[f"{prefix}{name}.bias"] = 0.1 * size * torch.randn(outputs, generator=generator)

    return add, generator


def _in_float64(state: State) -> tuple[State, Callable[[str, Tensor], Tensor]]:
    """Return a state in float64, and a function that applies a linear layer of it."""
    s = {name.removeprefix("deformation_net."): tensor.double() for name, tensor in state.items()}
    return s, lambda name, value: value @ s[f"{name}.weight"].T + s[f"{name}.bias"]


def deformgs_state(blender: bool, depth: int = 8, width: int = 64) -> State:
    state: State = {}
    add, _ = _random_layers(state)
    if blender:
        add("timenet.0", 13, 256)
        add("timenet.2", 256, 30)
    inputs = 63 + (30 if blender else 21)
    for i in range(depth):
        add(f"linear.{i}", inputs if i == 0 else width + inputs if i == depth // 2 + 1 else width, width)
    for name, size in (("gaussian_warp", 3), ("gaussian_scaling", 3), ("gaussian_rotation", 4)):
        add(name, width, size, 0.1)
    return state


def _encode(x: Tensor, frequencies: int) -> Tensor:
    parts = [x]
    for k in range(frequencies):
        parts += [torch.sin(2.0**k * x), torch.cos(2.0**k * x)]
    return torch.cat(parts, dim=-1)


def deformgs_deltas(state: State, x: Tensor, t: float) -> tuple[Tensor, Tensor, Tensor]:
    """Return the deltas of positions, rotations and scales by their network in float64."""
    s, linear = _in_float64(state)
    blender = "timenet.0.weight" in s
    time = _encode(torch.full((len(x), 1), t, dtype=torch.float64), 6 if blender else 10)
    if blender:
        time = linear("timenet.2", linear("timenet.0", time).relu())
    given = torch.cat([_encode(x.double(), 10), time], dim=-1)
    depth, hidden = sum(n.startswith("linear.") and n.endswith("bias") for n in s), given
    for i in range(depth):
        hidden = linear(f"linear.{i}", hidden).relu()
        if i == depth // 2:
            hidden = torch.cat([given, hidden], dim=-1)
    return linear("gaussian_warp", hidden), linear("gaussian_rotation", hidden), linear("gaussian_scaling", hidden)


def write_deformgs(folder: Path, state: State) -> Path:
    for iteration in (7_000, 40_000):
        cloud = folder / "point_cloud" / f"iteration_{iteration}" / "point_cloud.ply"
        network = folder / "deform" / f"iteration_{iteration}" / "deform.pth"
        cloud.parent.mkdir(parents=True)
        network.parent.mkdir(parents=True)
        cloud.write_bytes(ply_bytes(inria_columns(some_gaussians(COUNT, 3, seed=iteration))))
        torch.save(state, network)
    (folder / "cfg_args").write_text("Namespace(sh_degree=3, white_background=True, source_path=open('x'))")
    return folder


def fourdgs_state(scales: tuple[int, ...] = (1, 2)) -> State:
    state: State = {"deformation_net.grid.aabb": torch.tensor(BOX), "time_poc": torch.ones(4)}
    add, generator = _random_layers(state, "deformation_net.")
    for i, scale in enumerate(scales):
        nodes = [SPACE * scale] * 3 + [TIME]
        for j, (a, b) in enumerate(itertools.combinations(range(4), 2)):
            plane = 0.3 + torch.rand(1, CHANNELS, nodes[b], nodes[a], generator=generator)
            state[f"deformation_net.grid.grids.{i}.{j}"] = plane
    add("feature_out.0", CHANNELS * len(scales), WIDTH)
    for name, size in HEADS.items():
        add(f"{name}_deform.1", WIDTH, WIDTH)
        add(f"{name}_deform.3", WIDTH, size, 0.2)
    return state


def fourdgs_deltas(state: State, x: Tensor, t: float) -> dict[str, Tensor]:
    """Return the outputs of all heads of their network at positions [N, 3], in float64."""
    s, linear = _in_float64(state)
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
    hidden = linear("feature_out.0", torch.cat(features, dim=1)).relu()
    return {name: linear(f"{name}_deform.3", linear(f"{name}_deform.1", hidden).relu()) for name in HEADS}


def write_fourdgs(folder: Path, state: State, switches: str = SWITCHES, lengths: float = 0.5) -> Path:
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
    (folder / "cameras.json").write_text(json.dumps([stored_camera(index) for index in range(4)]))
    return folder


def stored_camera(index: int) -> dict[str, object]:
    pose = orbit(np.zeros(3), 4.0, 90 * index, 10, np.array([0.0, -1.0, 0.0]))
    size = {"width": 96, "height": 96, "fx": 96.0, "fy": 96.0}
    return {"img_name": f"{index}", "rotation": pose[:3, :3].tolist(), "position": pose[:3, 3].tolist(), **size}


def grid4d_states(width: int = 12, depth: int = 1, seed: int = 0) -> list[State]:
    """Small grids of Grid4D, of which the finest levels are hashed, and a network."""
    grids: State = {}
    network: State = {}
    add, _ = _random_layers(network)
    generator = torch.Generator().manual_seed(seed)
    for name, sizes in (
        ("xyz", (3, (4, 4, 4), (17, 17, 17), 2**8)),
        *((name, (2, (4, 4, 3), (9, 9, 5), 2**7)) for name in ("xyt", "yzt", "xzt")),
    ):
        count, coarsest, finest, _ = sizes
        starts = torch.from_numpy(Levels.between(*sizes).starts)
        ratios = [(last / first) ** (1 / (count - 1)) for first, last in zip(coarsest, finest, strict=True)]
        grids |= {
            f"{name}_encoding.embeddings": torch.rand(int(starts[-1]), 2, generator=generator) - 0.5,
            f"{name}_encoding.offsets": starts.int(),
            f"{name}_encoding.per_level_scale": torch.tensor(ratios),
            f"{name}_encoding.base_resolution": torch.tensor(coarsest).float(),
        }
    add("spatial_mlp.0", 6, width)
    add("temporal_mlp.0", 12, width)
    for i in range(depth):
        add(f"grid_mlp.{2 * i}", width, width)
    for name, size in (("gaussian_warp", 7), ("gaussian_rotation", 4), ("gaussian_scaling", 3)):
        add(name, width, size, 0.2)
    return [grids, network]


def write_grid4d(folder: Path, states: list[State], settings: str = "grid_args={'bound': 1.6}") -> Path:
    """Write a run of Grid4D, whose file has the states of its grids and of its network."""
    cloud = folder / "point_cloud" / "iteration_50000"
    network = folder / "deform" / "iteration_50000"
    for part in (cloud, network):
        part.mkdir(parents=True)
    (cloud / "point_cloud.ply").write_bytes(ply_bytes(inria_columns(some_gaussians(COUNT, 3))))
    torch.save(tuple(states), network / "deform.pth")
    (folder / "cfg_args").write_text(f"Namespace(sh_degree=3, {settings})")
    return folder

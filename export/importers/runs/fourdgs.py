"""Runs of 4DGaussians: features of six planes over a box and time, deltas in raw space, a small MLP for each."""

import math
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from export.importers.errors import ImportFailed
from export.importers.runs.state import State
from msdgs_serve.scene.spherical_harmonics import SH_DEGREES
from msdgs_train.gaussians.canonical import CanonicalGaussians
from msdgs_train.gaussians.model import DynamicGaussians, ModelConfig
from msdgs_train.gaussians.model_file import SceneInfo
from msdgs_train.gaussians.modulation import MAX_LOG_FACTOR
from msdgs_train.layers.plane import PlaneConfig, PlaneGrid, PlaneLayer

DEFAULTS = {"no_dx": False, "no_ds": False, "no_dr": False, "no_do": True, "no_dshs": True}
"""Of its switches, which cfg_args holds: which parts of a Gaussian don't change."""

HEADS = {"pos_deform": "no_dx", "scales_deform": "no_ds", "rotations_deform": "no_dr"}
HEADS |= {"opacity_deform": "no_do", "shs_deform": "no_dshs"}
"""Its networks in the order of `Heads.sizes`, and the switch of each."""

UNSUPPORTED_SWITCHES = ("no_grid", "grid_pe", "apply_rotation", "static_mlp", "empty_voxel")
"""Switches that make another network of it."""

SH_DEGREE = 3
"""Of what its head of colors changes."""

SPACE, TIME = (0, 1, 3), (2, 4, 5)
"""Which of its six planes are xy, xz, yz, and xt, yt, zt."""

MAX_UNITS = 4_096
"""A layer, and channels of all grids: sixteen times the usual and more."""

UNIT = 1e-4
"""Quaternions that are nearer to unit length all count as such: float32 as training leaves it."""


class _Sizes(NamedTuple):
    channels: int
    nodes: list[int]  # of space, a grid
    time_nodes: int
    width: int


class FourDGSImporter:
    """Of 4DGaussians."""

    white_background = True

    def detects(self, run: Path) -> bool:
        """Its networks lie beside the Gaussians."""
        return next(run.glob("point_cloud/iteration_*/deformation.pth"), None) is not None

    def read(
        self, run: Path, gaussians: CanonicalGaussians, iteration: int, settings: dict[str, Any]
    ) -> tuple[DynamicGaussians, list[str]]:
        """The model of an iteration, and notes."""
        return read_4dgs(run, gaussians, iteration, settings)

    def fidelity(self, model: DynamicGaussians, info: SceneInfo) -> None:
        """Its renderer draws the same."""


def read_4dgs(
    run: Path, gaussians: CanonicalGaussians, iteration: int, settings: dict[str, Any]
) -> tuple[DynamicGaussians, list[str]]:
    """The model of an iteration, and notes. Raises `ImportFailed` for networks that are built otherwise."""
    file = run / "point_cloud" / f"iteration_{iteration}" / "deformation.pth"
    if not file.is_file():
        raise ImportFailed(run, f"has point_cloud/iteration_{iteration} but no deformation.pth in it")
    state = State(file)
    for name in UNSUPPORTED_SWITCHES:
        if settings.get(name) or any(key.startswith(f"deformation_net.{name}.") for key in state.names()):
            raise ImportFailed(file, f"was trained with {name}, which no layer of this project has")
    if "deformation_net.feature_out.2.weight" in state:
        raise ImportFailed(file, "was trained with defor_depth above 1; a plane layer has one Linear before its heads")
    sizes = _sizes(state)
    off = {switch: bool(settings.get(switch, default)) for switch, default in DEFAULTS.items()}
    norms = gaussians.raw_quats.detach().norm(dim=1)
    scaled = bool(((norms - 1).abs() > UNIT).any())
    first, since = _read_times(sizes.time_nodes)
    base = math.gcd(*sizes.nodes)
    config = ModelConfig(
        sh_degree=SH_DEGREES[1 + gaussians.sh_rest.shape[1]],
        layers=(
            PlaneConfig(
                features=sizes.channels,
                resolution=base,
                time_resolution=sizes.time_nodes - first,
                width=sizes.width,
                multires=tuple(nodes // base for nodes in sizes.nodes),
            ),
        ),
        weights=False,
        embedding_dim=1 if scaled else 0,
        modulation_targets=("quats",),
        opacity_head=not off["no_do"],
        sh_head=not off["no_dshs"],
    )
    if config.sh_head and config.sh_degree != SH_DEGREE:
        raise ImportFailed(file, f"changes SH of degree {SH_DEGREE}, its point cloud has degree {config.sh_degree}")
    if scaled:
        tensors = {name: parameter.detach() for name, parameter in gaussians.named_parameters()}
        gaussians = CanonicalGaussians(**tensors | {"embeddings": -norms.log()[:, None]})
    heads_off = [name for name, switch in HEADS.items() if off[switch]]
    with torch.device("meta"):
        shapes_only = DynamicGaussians(config, gaussians)
    _fill(shapes_only, state, sizes, heads_off, first, since)  # all tensors must fit before memory is taken for any
    model = DynamicGaussians(config, gaussians)
    _fill(model, state, sizes, heads_off, first, since)
    if scaled:
        _divide_by_lengths(model)
    return model, _notes(settings, norms)


def _notes(settings: dict[str, Any], norms: Tensor) -> list[str]:
    notes = []
    missing = [name for name in DEFAULTS if name not in settings]
    if missing:
        notes.append(f"cfg_args doesn't say {', '.join(missing)}; 4DGaussians' own defaults are taken")
    outside = int((norms.log().abs() > MAX_LOG_FACTOR).sum())
    if outside:
        lengths = f"{math.exp(-MAX_LOG_FACTOR):.2f} to {math.exp(MAX_LOG_FACTOR):.2f}"
        notes.append(
            f"{outside:,} Gaussians have quaternions of lengths outside of {lengths}; they turn too much or little"
        )
    return notes


@torch.no_grad()
def _divide_by_lengths(model: DynamicGaussians) -> None:
    """Theirs is normalize(q + Δq) of a q of any length, ours of a unit one: Δq is modulated by 1 / |q|.

    The embedding is the logarithm of that, which two hidden units pass on: x = relu(x) − relu(−x).
    """
    modulation = model.modulation
    assert modulation is not None
    for linear in (modulation.hidden, modulation.output):
        linear.weight.zero_()
        linear.bias.zero_()
    for unit, sign in enumerate((1.0, -1.0)):
        modulation.hidden.weight[unit, 0] = sign
        modulation.output.weight[:, unit] = sign


def _sizes(state: State) -> _Sizes:
    """Of the planes of all grids, which must fit each other. Two nodes at least along each axis."""
    grids = sum(name.startswith("deformation_net.grid.grids.") and name.endswith(".0") for name in state.names())
    width = len(state.read("deformation_net.feature_out.0.bias", None))
    nodes, channels, time_nodes = [], 0, 0
    for i in range(grids):
        plane = state.read(f"deformation_net.grid.grids.{i}.2", 1, None, None, None)
        channels, time_nodes = plane.shape[1:3]
        nodes.append(plane.shape[3])
    if not nodes or min(*nodes, time_nodes) < 2 or channels < 1 or math.gcd(*nodes) < 2:
        raise ImportFailed(state.file, f"has planes of {nodes} nodes over space and {time_nodes} over time")
    if not (1 <= width <= MAX_UNITS and channels * len(nodes) <= MAX_UNITS):
        found = f"{width:,} units a layer and {len(nodes):,} grids of {channels:,} channels"
        raise ImportFailed(state.file, f"has {found}; from 1 to {MAX_UNITS:,} of each in all can be read")
    return _Sizes(channels, nodes, time_nodes, width)


def _read_times(nodes: int) -> tuple[int, float]:
    """The first node of time that is ever read, and its time.

    Time from 0 to 1 is given to a sampler that spans −1 to 1, so all before the node below the middle is unused.
    """
    first = (nodes - 1) // 2
    return first, 2 * first / (nodes - 1) - 1


@torch.no_grad()
def _fill(model: DynamicGaussians, state: State, sizes: _Sizes, off: list[str], first: int, since: float) -> None:
    layer = model.deformation.layers[0]
    assert isinstance(layer, PlaneLayer)
    box = state.read("deformation_net.grid.aabb", 2, 3).double()  # the corner at the sampler's −1 first, its largest
    size = box[1] - box[0]
    if not (size.abs() > 1e-6 * box.abs().max()).all():
        raise ImportFailed(state.file, f"its box is flat: {box.tolist()}")
    for i, (grid, nodes) in enumerate(zip(layer.plane_grids(), sizes.nodes, strict=True)):
        _fill_grid(grid, [_plane(state, i, p, nodes, sizes) for p in range(6)], first)
        grid.cells.copy_((nodes - 1) / size)
        grid.origin.copy_(-box[0] * (nodes - 1) / size)
        grid.first_time.fill_(since)
        grid.time_cells.fill_((sizes.time_nodes - 1) / 2)
    _set(layer.features, state, "feature_out.0")
    read = [name for name, size in zip(HEADS, layer.outputs.sizes, strict=False) if size]
    for name, hidden, head in zip(read, layer.hidden, layer.heads, strict=True):
        _set(hidden, state, f"{name}.1")
        if name in off:
            for parameter in head.parameters():
                parameter.zero_()
        else:
            _set(head, state, f"{name}.3")


def _plane(state: State, grid: int, plane: int, nodes: int, sizes: _Sizes) -> Tensor:
    """[C, second axis, first axis]"""
    second = sizes.time_nodes if plane in TIME else nodes
    return state.read(f"deformation_net.grid.grids.{grid}.{plane}", 1, sizes.channels, second, nodes)[0]


def _fill_grid(grid: PlaneGrid, planes: list[Tensor], first: int) -> None:
    for ours, theirs in enumerate(SPACE):
        grid.space[ours] = planes[theirs].permute(2, 1, 0)
    for ours, theirs in enumerate(TIME):
        grid.time[ours] = planes[theirs][:, first:].permute(1, 2, 0)


def _set(linear: nn.Module, state: State, name: str) -> None:
    for kind in ("weight", "bias"):
        parameter = linear.get_parameter(kind)
        parameter.copy_(state.read(f"deformation_net.{name}.{kind}", *parameter.shape))

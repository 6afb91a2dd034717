"""Runs of 4DGaussians: features of six planes over a box and time, deltas in raw space, a small MLP for each."""

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from msdgs_export.importers.errors import ImportFailed
from msdgs_export.importers.runs.base import filled_model
from msdgs_export.importers.runs.state import RunFolder, State
from msdgs_serve.scene.spherical_harmonics import SH_DEGREES
from msdgs_train.gaussians.canonical import CanonicalGaussians
from msdgs_train.gaussians.model import DynamicGaussians, ModelConfig
from msdgs_train.gaussians.model_file import SceneInfo
from msdgs_train.gaussians.modulation import MAX_LOG_FACTOR
from msdgs_train.layers.plane import PlaneConfig, PlaneLayer

DEFAULTS = {"no_dx": False, "no_ds": False, "no_dr": False, "no_do": True, "no_dshs": True}
"""Switches of cfg_args with their defaults: parts of a Gaussian that don't change."""

HEADS = {"pos_deform": "no_dx", "scales_deform": "no_ds", "rotations_deform": "no_dr"}
HEADS |= {"opacity_deform": "no_do", "shs_deform": "no_dshs"}
"""Networks of the heads in the order of `Heads.sizes`, and the switch of each."""

UNSUPPORTED_SWITCHES = ("no_grid", "grid_pe", "apply_rotation", "static_mlp", "empty_voxel")
"""Switches that change the structure of the network."""

SH_DEGREE = 3
"""SH degree that the head of colors requires."""

SPACE, TIME = (0, 1, 3), (2, 4, 5)
"""Indices of the planes xy, xz, yz and xt, yt, zt among the stored six."""

MAX_UNITS = 4_096
"""Units of a layer, and channels of all grids: sixteen times the usual and more."""

UNIT_TOLERANCE = 1e-4
"""If the norms of all quaternions differ from 1 by less, they count as unit quaternions: float32 of a training."""

NET = "deformation_net"


class _Sizes(NamedTuple):
    channels: int
    nodes: list[int]  # over space, by grid
    time_nodes: int
    width: int

    @property
    def first_time_node(self) -> int:
        """The first node of time that is ever read. Time from 0 to 1 is given to a sampler that spans −1 to 1, so nodes
        below the one before the middle are unused."""
        return (self.time_nodes - 1) // 2


class FourDGSImporter:
    """Importer of 4DGaussians."""

    networks = "point_cloud/iteration_*/deformation.pth"
    marker = ""
    white_background = True

    def read(self, run: RunFolder, gaussians: CanonicalGaussians) -> tuple[DynamicGaussians, list[str]]:
        """The model of a run, and notes."""
        state, settings = run.state, run.settings
        for name in UNSUPPORTED_SWITCHES:
            if settings.get(name) or any(key.startswith(f"{NET}.{name}.") for key in state.names()):
                raise ImportFailed(state.file, f"was trained with {name}, which no layer of this project has")
        if f"{NET}.feature_out.2.weight" in state:
            problem = "was trained with defor_depth above 1; a plane layer has one Linear before its heads"
            raise ImportFailed(state.file, problem)
        sizes, base_degree = _sizes(state), SH_DEGREES[1 + gaussians.sh_rest.shape[1]]
        off = {switch: bool(settings.get(switch, default)) for switch, default in DEFAULTS.items()}
        if not off["no_dshs"] and base_degree != SH_DEGREE:
            raise ImportFailed(
                state.file, f"changes SH of degree {SH_DEGREE}, its point cloud has degree {base_degree}"
            )
        norms = gaussians.raw_quats.detach().norm(dim=1)
        scaled = bool(((norms - 1).abs() > UNIT_TOLERANCE).any())
        resolution = math.gcd(*sizes.nodes)
        layer = PlaneConfig(
            features=sizes.channels,
            resolution=resolution,
            time_resolution=sizes.time_nodes - sizes.first_time_node,
            width=sizes.width,
            multires=tuple(nodes // resolution for nodes in sizes.nodes),
        )
        config = ModelConfig(
            sh_degree=base_degree,
            layers=(layer,),
            weights=False,
            embedding_dim=1 if scaled else 0,
            modulation_targets=("quats",),
            opacity_head=not off["no_do"],
            sh_head=not off["no_dshs"],
        )
        if scaled:
            tensors = {name: parameter.detach() for name, parameter in gaussians.named_parameters()}
            gaussians = CanonicalGaussians(**tensors | {"embeddings": -norms.log()[:, None]})
        heads_off = [name for name, switch in HEADS.items() if off[switch]]
        model = filled_model(config, gaussians, lambda model: _fill(model, state, sizes, heads_off))
        if scaled:
            _divide_by_lengths(model)
        return model, _notes(settings, norms)

    def fidelity(self, model: DynamicGaussians, info: SceneInfo) -> None:
        """Its renderer draws the same."""


def _notes(settings: dict[str, Any], norms: Tensor) -> list[str]:
    notes = []
    missing = [name for name in DEFAULTS if name not in settings]
    if missing:
        notes.append(f"cfg_args lacks {', '.join(missing)}; 4DGaussians' own defaults are used")
    outside = int((norms.log().abs() > MAX_LOG_FACTOR).sum())
    if outside:
        lengths = f"{math.exp(-MAX_LOG_FACTOR):.2f} to {math.exp(MAX_LOG_FACTOR):.2f}"
        notes.append(
            f"{outside:,} Gaussians have quaternions of norms outside {lengths}; their rotations are too large or small"
        )
    return notes


@torch.no_grad()
def _divide_by_lengths(model: DynamicGaussians) -> None:
    """4DGaussians normalizes q + Δq for q of any norm, this project for unit q, so Δq is modulated by 1 / |q|.

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
    """The sizes of the planes of all grids, which must fit each other and have two nodes or more along each axis."""
    grids = sum(name.startswith(f"{NET}.grid.grids.") and name.endswith(".0") for name in state.names())
    width = len(state.read(f"{NET}.feature_out.0.bias", None))
    nodes, channels, time_nodes = [], 0, 0
    for i in range(grids):
        plane = state.read(f"{NET}.grid.grids.{i}.2", 1, None, None, None)
        channels, time_nodes = plane.shape[1:3]
        nodes.append(plane.shape[3])
    if not nodes or min(*nodes, time_nodes) < 2 or channels < 1 or math.gcd(*nodes) < 2:
        raise ImportFailed(state.file, f"has planes of {nodes} nodes over space and {time_nodes} over time")
    if not (1 <= width <= MAX_UNITS and channels * len(nodes) <= MAX_UNITS):
        found = f"{width:,} units a layer and {len(nodes):,} grids of {channels:,} channels"
        raise ImportFailed(state.file, f"has {found}; from 1 to {MAX_UNITS:,} of each in all can be read")
    return _Sizes(channels, nodes, time_nodes, width)


@torch.no_grad()
def _fill(model: DynamicGaussians, state: State, sizes: _Sizes, heads_off: list[str]) -> None:
    layer, first = model.deformation.layers[0], sizes.first_time_node
    assert isinstance(layer, PlaneLayer)
    box = state.read(f"{NET}.grid.aabb", 2, 3).double()  # the corner at the sampler's −1 first, its largest
    size = box[1] - box[0]
    if not (size.abs() > 1e-6 * box.abs().max()).all():
        raise ImportFailed(state.file, f"its box is flat: {box.tolist()}")
    for i, (grid, nodes) in enumerate(zip(layer.plane_grids(), sizes.nodes, strict=True)):
        for p, stored in enumerate(SPACE):
            grid.space[p] = _plane(state, i, stored, sizes.channels, nodes, nodes).permute(2, 1, 0)
        for p, stored in enumerate(TIME):
            plane = _plane(state, i, stored, sizes.channels, sizes.time_nodes, nodes)
            grid.time[p] = plane[:, first:].permute(1, 2, 0)
        grid.cells.copy_((nodes - 1) / size)
        grid.origin.copy_(-box[0] * (nodes - 1) / size)
        grid.first_time.fill_(2 * first / (sizes.time_nodes - 1) - 1)
        grid.time_cells.fill_((sizes.time_nodes - 1) / 2)
    state.fill(layer.features, f"{NET}.feature_out.0")
    names = [name for name, size in zip(HEADS, layer.outputs.sizes, strict=False) if size]
    for name, hidden, head in zip(names, layer.hidden, layer.heads, strict=True):
        state.fill(hidden, f"{NET}.{name}.1")
        if name in heads_off:
            for parameter in head.parameters():
                parameter.zero_()
        else:
            state.fill(head, f"{NET}.{name}.3")


def _plane(state: State, grid: int, plane: int, *shape: int) -> Tensor:
    """[C, second axis, first axis] one plane of a grid."""
    return state.read(f"{NET}.grid.grids.{grid}.{plane}", 1, *shape)[0]

"""Runs of Grid4D: hash grids over space and over two axes of space and time, deltas in activated space."""

import math
from typing import Any

import torch
from torch import Tensor, nn

from msdgs_export.importers.errors import ImportFailed
from msdgs_export.importers.runs.base import Loss, filled_model
from msdgs_export.importers.runs.fidelity import quaternion_fidelity
from msdgs_export.importers.runs.state import RunFolder, State
from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.scene.spherical_harmonics import SH_DEGREES
from msdgs_train.gaussians.canonical import CanonicalGaussians
from msdgs_train.gaussians.model import DynamicGaussians, ModelConfig
from msdgs_train.gaussians.model_file import SceneInfo
from msdgs_train.layers.hash4d import Hash4DConfig, Hash4DLayer
from msdgs_train.layers.hash_grid import HashGrid

CANONICAL, TEMPORAL = "0.xyz_encoding", ("0.xyt_encoding", "0.yzt_encoding", "0.xzt_encoding")
HEADS = ("1.gaussian_warp", 7), ("1.gaussian_scaling", 3), ("1.gaussian_rotation", 4)
"""Networks of the heads in the order of the layer's outputs, and their numbers of outputs."""

BOUND = 1.6
"""Half the side of the grids' cube, if cfg_args don't say."""


class Grid4DImporter:
    """Importer of Grid4D."""

    networks = "deform/iteration_*/deform.pth"
    marker = "xyz_encoding.embeddings"
    white_background = False

    def read(self, run: RunFolder, gaussians: CanonicalGaussians) -> tuple[DynamicGaussians, list[str]]:
        """The model of a run, and notes."""
        state, grid_args = run.state, run.settings.get("grid_args")
        network_args = run.settings.get("network_args")
        if isinstance(network_args, dict) and not network_args.get("directional", True):
            raise ImportFailed(state.file, "was trained with directional=False, which no layer of this project has")
        bound = grid_args.get("bound", BOUND) if isinstance(grid_args, dict) else BOUND
        half_sizes = _half_sizes(state, bound, run.settings.get("scale_xyz", 1.0))
        try:
            config = ModelConfig(
                sh_degree=SH_DEGREES[1 + gaussians.sh_rest.shape[1]],
                layers=(_layer_config(state),),
                weights=False,
                embedding_dim=0,
                scale_space="linear",
            )
        except InvalidInput as error:
            raise ImportFailed(state.file, f"has sizes that can't be read: {error}") from error
        model = filled_model(config, gaussians, lambda model: _fill(model, state, half_sizes))
        known = isinstance(grid_args, dict) and "bound" in grid_args
        return model, [] if known else [f"cfg_args lacks grid_args with a bound; Grid4D's own, {BOUND}, is used"]

    def fidelity(self, model: DynamicGaussians, info: SceneInfo) -> Loss:
        """Its rasterizer doesn't normalize quaternions."""
        return quaternion_fidelity(model, info)


def _half_sizes(state: State, bound: Any, scale: Any) -> Tensor:
    """[3] half sides of the grids' box, scene units."""
    scales = scale if isinstance(scale, list | tuple) else [scale] * 3
    numbers = [bound, *scales]
    if len(scales) != 3 or not all(type(n) in (int, float) and 0 < n < math.inf for n in numbers):
        found = f"bound={bound!r} and scale_xyz={scale!r}"
        raise ImportFailed(state.file, f"its cfg_args have {found}, not positive numbers")
    return torch.tensor([bound / each for each in scales])


def _layer_config(state: State) -> Hash4DConfig:
    """The sizes, of which a table stores its levels' first rows, and the nodes of the coarsest with their ratios."""
    coarsest, finest, levels, log2_rows = _levels(state, TEMPORAL[0])
    canonical = _levels(state, CANONICAL)
    return Hash4DConfig(
        levels=levels,
        coarsest=coarsest,
        finest=finest,
        log2_rows=log2_rows,
        canonical_levels=canonical[2],
        canonical_coarsest=canonical[0],
        canonical_finest=canonical[1],
        canonical_log2_rows=canonical[3],
        channels=state.read(f"{CANONICAL}.embeddings", None, None).shape[1],
        width=len(state.read("1.spatial_mlp.0.bias", None)),
        depth=sum(name.startswith("1.grid_mlp.") and name.endswith(".weight") for name in state.names()),
    )


def _levels(state: State, name: str) -> tuple[tuple[int, ...], tuple[int, ...], int, int]:
    """Nodes of the coarsest and of the finest level, the number of levels, and the logarithm of the most rows."""
    starts = state.read(f"{name}.offsets", None)
    ratios, coarsest = (state.read(f"{name}.{part}", 3).double() for part in ("per_level_scale", "base_resolution"))
    levels, most = len(starts) - 1, float(starts.diff().max()) if len(starts) > 1 else 0.0
    if levels < 2 or most < 1:
        raise ImportFailed(state.file, f"`{name}.offsets` has {len(starts)} rows, of two levels or more")
    finest = coarsest * ratios ** (levels - 1)
    if not (torch.isfinite(finest).all() and (finest.abs() < 2**31).all()):
        raise ImportFailed(state.file, f"`{name}.per_level_scale` gives {finest.tolist()} nodes")
    first, last = (tuple(map(int, nodes.round())) for nodes in (coarsest, finest))
    return first, last, levels, max(math.ceil(math.log2(most)), 1)


@torch.no_grad()
def _fill(model: DynamicGaussians, state: State, half_sizes: Tensor) -> None:
    layer = model.deformation.layers[0]
    assert isinstance(layer, Hash4DLayer)
    for name, grid in zip((CANONICAL, *TEMPORAL), (layer.canonical, *layer.temporal), strict=True):
        assert isinstance(grid, HashGrid)
        starts = grid.levels.starts
        if not torch.equal(state.read(f"{name}.offsets", len(starts)).long(), torch.from_numpy(starts)):
            raise ImportFailed(state.file, f"`{name}.offsets` aren't those of levels from `base_resolution` on")
        grid.table.copy_(state.read(f"{name}.embeddings", *grid.table.shape))
    state.fill(layer.from_canonical, "1.spatial_mlp.0")
    state.fill(layer.from_temporal, "1.temporal_mlp.0")
    for i, linear in enumerate(layer.hidden):
        assert isinstance(linear, nn.Linear)
        state.fill(linear, f"1.grid_mlp.{2 * i}")
    width = layer.heads.in_features
    layer.heads.weight.copy_(torch.cat([state.read(f"{name}.weight", size, width) for name, size in HEADS]))
    layer.heads.bias.copy_(torch.cat([state.read(f"{name}.bias", size) for name, size in HEADS]))
    layer.half_sizes.copy_(half_sizes)

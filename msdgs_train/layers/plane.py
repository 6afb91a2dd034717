"""One step of deformation read from six planes of features over space and time (paper, section 3.3, equation 11)."""

import functools
import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.threads import run_parallel, split_evenly
from msdgs_train.layers import arrays
from msdgs_train.layers.arrays import to_array
from msdgs_train.layers.base import (
    PAPER_HEADS,
    DeformationLayer,
    Heads,
    LayerConfig,
    LayerStep,
    SceneBounds,
    check_size,
)
from msdgs_train.layers.parameters import LearningRate, ParamGroup
from msdgs_train.layers.plane_kernels import plane_features, plane_gradients
from msdgs_train.layers.plane_sampling import sampled_features

PARTS = 4  # that the rows are split into; fixed, so that sums have the same order whatever the number of threads
SPACE_INIT = (0.1, 0.5)


@dataclass(frozen=True)
class PlaneConfig(LayerConfig):
    """Sizes, learning rates and regularizers of a plane layer; the sizes are the paper's."""

    kind: ClassVar[str] = "plane"
    features: int = 16
    """Channels of a plane."""
    resolution: int = 32
    """Nodes of a plane along each axis of space."""
    time_resolution: int = 50
    """Nodes along time."""
    width: int = 32
    """Hidden units."""
    multires: tuple[int, ...] = (1,)
    """One grid per factor of `resolution`; their features are concatenated. 4DGS has (1, 2)."""
    initialization: str = "zero"
    """`zero`: zero deltas; `xavier`: the weights of all Linears uniform (Glorot), as in 4DGaussians."""
    lr_init: float = 2e-3
    """Learning rate of the networks until all times take part."""
    lr_final: float = 2e-5
    """Learning rate of the networks at the last step, to which it decays exponentially."""
    grid_lr_init: float = 1e-2
    """Learning rate of the grids until all times take part."""
    grid_lr_final: float = 1e-3
    """Learning rate of the grids at the last step."""
    time_smoothness_weight: float = 1e-2
    """Weight of the mean squared second difference along time."""
    l1_time_planes_weight: float = 0.0
    """Weight of the mean distance of the planes over time from 1, their neutral value."""
    plane_tv_weight: float = 1e-4
    """Weight of the mean squared first difference along space."""
    plane_smoothness_weight: float = 0.0
    """Weight of the mean squared second difference along space, what 4DGS calls plane_tv."""
    smooths_one_axis: bool = False
    """That difference is along the second axis of a plane alone, as in the code of 4DGaussians."""
    tv_weight: float = 0.0
    """Weight of HexPlane's total variation: twice the mean squared first difference along each axis of all planes,
    along time four times, summed over the planes."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "multires", tuple(self.multires))

    def build(self, bounds: SceneBounds, heads: Heads, num_points: int | None) -> "PlaneLayer":
        return PlaneLayer(self, bounds, heads)

    def check(self, field: str, moves_nodes: bool) -> None:
        for name, least in (("features", 1), ("resolution", 2), ("time_resolution", 2), ("width", 1)):
            check_size(f"{field}.{name}", getattr(self, name), least)
        if self.initialization not in ("zero", "xavier"):
            raise InvalidInput(f"{field}.initialization", "zero or xavier", self.initialization)
        if not self.multires:
            raise InvalidInput(f"{field}.multires", "one grid or more", self.multires)
        for factor in self.multires:
            check_size(f"{field}.multires", factor)


class PlaneGrid(nn.Module):
    """xy, xz, yz, xt, yt, zt planes of features, interpolated and multiplied.

    Planes over time are initialized to ones, so that a new grid doesn't depend on time. It spans the time range and a
    cube of space (an imported one, any box); positions outside read the features of the border.
    """

    cells: Tensor
    origin: Tensor
    first_time: Tensor
    time_cells: Tensor

    def __init__(
        self, channels: int, space_nodes: int, time_nodes: int, scene_half_size: float, time_range: tuple[float, float]
    ) -> None:
        super().__init__()
        self.space = nn.Parameter(torch.empty(3, space_nodes, space_nodes, channels).uniform_(*SPACE_INIT))
        self.time = nn.Parameter(torch.ones(3, time_nodes, space_nodes, channels))
        self.register_buffer(
            "cells", torch.full((3,), (space_nodes - 1) / (2 * scene_half_size))
        )  # per scene unit, by axis
        self.register_buffer("origin", torch.full((3,), (space_nodes - 1) / 2))  # where (0, 0, 0) is, in cells
        first, last = time_range
        self.register_buffer("first_time", torch.tensor(first))
        self.register_buffer("time_cells", torch.tensor((time_nodes - 1) / ((last - first) or 1.0)))  # a unit of time

    def forward(self, means: Tensor, t: Tensor) -> Tensor:
        """Features [N, C] of means, [N, 3], at time `t`, a scalar tensor."""
        positions = means * self.cells + self.origin
        read = _PlaneFeatures.apply if arrays.has_kernels(positions) else sampled_features
        return read(self.space, self.lines(t), positions)

    def lines(self, t: Tensor) -> Tensor:
        """[3, S, C] the planes over time at time `t`, which is clamped to the time range."""
        nodes = self.time.shape[1]
        place = ((t - self.first_time) * self.time_cells).clamp(0, nodes - 1)
        below = place.floor().clamp(max=nodes - 2)
        if arrays.has_kernels(below):
            index = int(below)
            return torch.lerp(self.time[:, index], self.time[:, index + 1], place - below)
        first = below.long()  # stays on the device, which the CPU doesn't wait for
        before, after = self.time.index_select(1, torch.stack((first, first + 1))).unbind(dim=1)
        return torch.lerp(before, after, place - below)

    @torch.no_grad()
    def on_window(self, before: float, after: float) -> None:
        """Extrapolate when the time window, centered in the range, widens.

        `before` and `after` are half widths, as fractions of the range. Nodes of time that enter copy the outermost
        one inside, so that motion continues from the last known state.
        """
        last = self.time.shape[1] - 1
        (low, high), (new_low, new_high) = (
            (max(math.floor((0.5 - half) * last), 0), min(math.ceil((0.5 + half) * last), last))
            for half in (before, after)
        )
        self.time[:, new_low:low] = self.time[:, low : low + 1]
        self.time[:, high + 1 : new_high + 1] = self.time[:, high : high + 1]

    def time_smoothness(self) -> Tensor:
        """Mean squared second difference along time, 0 for two nodes."""
        return _mean_square(self.time.diff(n=2, dim=1))

    def l1_time_planes(self) -> Tensor:
        """Mean distance of the planes over time from 1, their neutral value."""
        return (1 - self.time).abs().mean()

    def plane_tv(self) -> Tensor:
        """Mean squared first difference along space, the sum of both axes of a plane."""
        return self.space.diff(dim=1).square().mean() + self.space.diff(dim=2).square().mean()

    def plane_smoothness(self, one_axis: bool = False) -> Tensor:
        """Mean squared second difference along space, the sum of both axes of a plane, or the second alone; 0 for two
        nodes a side."""
        second = _mean_square(self.space.diff(n=2, dim=2))
        return second if one_axis else _mean_square(self.space.diff(n=2, dim=1)) + second

    def total_variation(self) -> Tensor:
        """HexPlane's, with both axes of all planes, of which time counts twice; a sum over the planes."""
        space = _mean_square(self.time.diff(dim=2)) + 2 * _mean_square(self.time.diff(dim=1)) + self.plane_tv()
        return 2 * len(self.space) * space


def _mean_square(differences: Tensor) -> Tensor:
    return differences.square().mean() if differences.numel() else differences.sum()


class PlaneLayer(DeformationLayer):
    """D_k of equation 11: features of planes over space and time, then one small MLP per head.

    The paper's has one grid, a simplification of 4DGS's HexPlane: 131,083 parameters at the default sizes. With
    `multires` (1, 2), 32 features, 64 and 75 nodes, width 64 and no weight it is the network of 4DGS, 3,365,770
    parameters, but for its heads of opacity and SH, which 4DGS itself leaves out unless asked for.
    """

    kind = "plane"

    def __init__(
        self, config: PlaneConfig = PlaneConfig(), bounds: SceneBounds = SceneBounds(), outputs: Heads = PAPER_HEADS
    ) -> None:
        super().__init__()
        c, self.config, self.outputs = config, config, outputs
        self.grids = nn.ModuleList(
            PlaneGrid(c.features, c.resolution * factor, c.time_resolution, *bounds) for factor in c.multires
        )
        width, sizes = c.width, [size for size in outputs.sizes if size]
        self.features = nn.Linear(c.features * len(c.multires), width)
        self.hidden = nn.ModuleList(nn.Linear(width, width) for _ in sizes)
        self.heads = nn.ModuleList(nn.Linear(width, size) for size in sizes)
        if c.initialization == "xavier":
            for linear in (module for module in self.modules() if isinstance(module, nn.Linear)):
                nn.init.xavier_uniform_(linear.weight)
        else:
            self._zero_deltas()

    @torch.no_grad()
    def _zero_deltas(self) -> None:
        for i, head in enumerate(self.heads):
            head.get_parameter("bias").zero_()
            # the step weight, the last head, keeps random parameters
            if not (self.outputs.weight and i == len(self.heads) - 1):
                head.get_parameter("weight").zero_()

    def plane_grids(self) -> list[PlaneGrid]:
        """Grids from the coarsest to the finest, as in `multires`."""
        return [grid for grid in self.grids if isinstance(grid, PlaneGrid)]

    def forward(self, means: Tensor, t: Tensor) -> LayerStep:
        read = torch.cat([grid(means, t) for grid in self.grids], dim=1)
        features = self.features(read).relu()
        heads = zip(self.hidden, self.heads, strict=True)
        columns = torch.cat([head(hidden(features).relu()) for hidden, head in heads], dim=1)
        return LayerStep.of_columns(columns, self.outputs)

    def parameter_groups(self) -> list[ParamGroup]:
        grids = [planes for grid in self.plane_grids() for planes in (grid.space, grid.time)]
        own = {id(p) for p in grids}
        networks = [p for p in self.parameters() if id(p) not in own]
        c = self.config
        return [
            ParamGroup("grids", grids, LearningRate(c.grid_lr_init, c.grid_lr_final, holds=True), True),
            ParamGroup("networks", networks, LearningRate(c.lr_init, c.lr_final, holds=True), True),
        ]

    def regularizers(self, points: Tensor, t: Tensor, generator: torch.Generator) -> dict[str, Tensor]:
        c, terms = self.config, {}
        for i, grid in enumerate(self.plane_grids()):
            smoothness = functools.partial(grid.plane_smoothness, c.smooths_one_axis)
            for weight, name, term in (
                (c.time_smoothness_weight, "time_smoothness", grid.time_smoothness),
                (c.l1_time_planes_weight, "l1_time_planes", grid.l1_time_planes),
                (c.plane_tv_weight, "plane_tv", grid.plane_tv),
                (c.plane_smoothness_weight, "plane_smoothness", smoothness),
                (c.tv_weight, "tv", grid.total_variation),
            ):
                if weight:
                    terms[f"{name}_{i}"] = weight * term()
        return terms

    def on_window(self, before: float, after: float) -> None:
        for grid in self.plane_grids():
            grid.on_window(before, after)


class _PlaneFeatures(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, space: Tensor, lines: Tensor, positions: Tensor) -> Tensor:
        ctx.save_for_backward(space, lines, positions)
        arrays = [to_array(tensor) for tensor in (space, lines, positions)]
        features = np.empty((len(positions), space.shape[3]), arrays[0].dtype)
        run_parallel(plane_features, [(*arrays, a, b, features) for a, b in split_evenly(len(positions), PARTS)])
        return torch.from_numpy(features).to(positions.device)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, ...]:  # type: ignore[override]
        space, lines, positions = (to_array(tensor) for tensor in ctx.saved_tensors)
        grad_features, grad_positions = to_array(grad), np.empty_like(positions)
        rows = split_evenly(len(positions), PARTS) or [(0, 0)]
        grads = [(np.zeros_like(space), np.zeros_like(lines)) for _ in rows]
        run_parallel(
            plane_gradients,
            [
                (space, lines, positions, grad_features, a, b, *part, grad_positions)
                for (a, b), part in zip(rows, grads, strict=True)
            ],
        )
        sums = (np.sum(parts, axis=0) for parts in zip(*grads, strict=True))
        return (*(torch.from_numpy(array).to(grad.device) for array in (*sums, grad_positions)),)

"""One step of deformation read from six planes of features over space and time (paper, section 3.3, equation 11)."""

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from msdgs_serve.threads import run_parallel, split_evenly
from msdgs_train.layers.heads import PAPER_HEADS, Heads
from msdgs_train.layers.mlp import LayerStep, to_array
from msdgs_train.layers.plane_kernels import plane_features, plane_gradients

PARTS = 4  # that the rows are split into; fixed, so that sums have the same order whatever the number of threads
SPACE_INIT = (0.1, 0.5)


class PlaneGrid(nn.Module):
    """xy, xz, yz, xt, yt, zt planes of features, interpolated and multiplied.

    Planes over time begin as ones, so that a new grid knows space only. It spans the whole of the time range and a cube
    of space (one that is imported, any box); beyond its border a Gaussian reads the border's features.
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
        )  # a scene unit, by axis
        self.register_buffer("origin", torch.full((3,), (space_nodes - 1) / 2))  # where (0, 0, 0) is, in cells
        first, last = time_range
        self.register_buffer("first_time", torch.tensor(first))
        self.register_buffer("time_cells", torch.tensor((time_nodes - 1) / ((last - first) or 1.0)))  # a unit of time

    def forward(self, means: Tensor, t: Tensor) -> Tensor:
        """Features [N, C] of means, [N, 3], at time `t`, a scalar tensor."""
        positions = means * self.cells + self.origin
        return _PlaneFeatures.apply(self.space, self.lines(t), positions)

    def lines(self, t: Tensor) -> Tensor:
        """[3, S, C] the planes over time at time `t`; the ends of the range hold beyond them."""
        nodes = self.time.shape[1]
        place = ((t - self.first_time) * self.time_cells).clamp(0, nodes - 1)
        below = place.floor().clamp(max=nodes - 2)
        index = int(below)
        return torch.lerp(self.time[:, index], self.time[:, index + 1], place - below)

    @torch.no_grad()
    def on_window(self, before: float, after: float) -> None:
        """Copy what is known outwards when training's time window, around the middle of the range, widens.

        `before` and `after` are half its widths, as parts of the range. A node of time that enters takes the values
        of the outermost one that was in: what moves goes on from where it is, not from where it was in the middle.
        """
        last = self.time.shape[1] - 1
        (low, high), (new_low, new_high) = (
            (max(math.floor((0.5 - half) * last), 0), min(math.ceil((0.5 + half) * last), last))
            for half in (before, after)
        )
        self.time[:, new_low:low] = self.time[:, low : low + 1]
        self.time[:, high + 1 : new_high + 1] = self.time[:, high : high + 1]

    def time_smoothness(self) -> Tensor:
        """Mean squared second difference along time."""
        return self.time.diff(n=2, dim=1).square().mean()

    def l1_time_planes(self) -> Tensor:
        """Mean distance of the planes over time from 1, at which they change nothing."""
        return (1 - self.time).abs().mean()

    def plane_tv(self) -> Tensor:
        """Mean squared first difference along space, the sum of both axes of a plane."""
        return self.space.diff(dim=1).square().mean() + self.space.diff(dim=2).square().mean()

    def plane_smoothness(self) -> Tensor:
        """Mean squared second difference along space, the sum of both axes of a plane."""
        return self.space.diff(n=2, dim=1).square().mean() + self.space.diff(n=2, dim=2).square().mean()


class PlaneLayer(nn.Module):
    """D_k of equation 11: features of planes over space and time, then one small MLP a head.

    The paper's has one grid, a simplification of 4DGS's HexPlane: 131,083 parameters at the default sizes. With
    `scales` (1, 2), 32 channels, 64 and 75 nodes, width 64 and no weight it is the network of 4DGS, 3,365,770
    parameters, but for its heads of opacity and SH, which 4DGS itself leaves out unless asked for.
    """

    kind = "plane"

    def __init__(
        self,
        channels: int = 16,
        space_nodes: int = 32,
        time_nodes: int = 50,
        width: int = 32,
        scene_half_size: float = 1.0,
        time_range: tuple[float, float] = (0.0, 1.0),
        scales: tuple[int, ...] = (1,),
        outputs: Heads = PAPER_HEADS,
    ) -> None:
        """`scales`: a grid each, with so many times `space_nodes`; their features are put side by side."""
        super().__init__()
        self.outputs = outputs
        self.grids = nn.ModuleList(
            PlaneGrid(channels, space_nodes * scale, time_nodes, scene_half_size, time_range) for scale in scales
        )
        self.features = nn.Linear(channels * len(scales), width)
        sizes = [size for size in outputs.sizes if size]
        self.hidden = nn.ModuleList(nn.Linear(width, width) for _ in sizes)
        self.heads = nn.ModuleList(nn.Linear(width, size) for size in sizes)
        self.register_load_state_dict_pre_hook(_name_the_grid)
        with torch.no_grad():
            for i, head in enumerate(self.heads):
                head.get_parameter(
                    "bias"
                ).zero_()  # a new layer moves nothing; its weight learns from a random direction
                if not (outputs.weight and i == len(sizes) - 1):
                    head.get_parameter("weight").zero_()

    def plane_grids(self) -> list[PlaneGrid]:
        """From the coarsest to the finest, as `scales` has them."""
        return [grid for grid in self.grids if isinstance(grid, PlaneGrid)]

    def forward(self, means: Tensor, t: Tensor) -> LayerStep:
        """The step of means, [N, 3], at time `t`, a scalar tensor of the same dtype and device."""
        read = torch.cat([grid(means, t) for grid in self.grids], dim=1)
        features = self.features(read).relu()
        heads = zip(self.hidden, self.heads, strict=True)
        columns = torch.cat([head(hidden(features).relu()) for hidden, head in heads], dim=1)
        return LayerStep.of_columns(columns, self.outputs)

    def extra_repr(self) -> str:
        return f"{sum(p.numel() for p in self.parameters()):,} parameters"


def _name_the_grid(layer: nn.Module, state: dict[str, Any], prefix: str, *_: Any) -> None:
    """Older models hold the only grid's tensors under the layer's own name, and one size of cells for all axes."""
    for name in ("space", "time", "cells", "first_time", "time_cells"):
        if prefix + name in state:
            state[f"{prefix}grids.0.{name}"] = state.pop(prefix + name)
    for name in [name for name in state if name.startswith(f"{prefix}grids.") and name.endswith(".cells")]:
        grid = name.removesuffix("cells")
        if state[name].ndim == 0 and f"{grid}space" in state:
            state[name] = state[name].expand(3).clone()
            state[f"{grid}origin"] = torch.full_like(state[name], (state[f"{grid}space"].shape[1] - 1) / 2)


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

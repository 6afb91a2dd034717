"""One step of deformation read from six planes of features over space and time (paper, section 3.3, equation 11)."""

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from msdgs_serve.threads import run_parallel, split_evenly
from msdgs_train.layers import HEAD_SIZES, LayerStep
from msdgs_train.plane_kernels import plane_features, plane_gradients

PARTS = 4  # that the rows are split into; fixed, so that sums have the same order whatever the number of threads
SPACE_INIT = (0.1, 0.5)


class PlaneLayer(nn.Module):
    """D_k of equation 11: xy, xz, yz, xt, yt, zt planes, their features multiplied, then one small MLP a head.

    A simplification of 4DGS's HexPlane to one resolution. At the default sizes it has 131,083 parameters. Planes over
    time begin as ones, so that a new layer knows space only. The grid spans the whole of the time range and a cube
    of space; beyond its border a Gaussian reads the border's features.
    """

    kind = "plane"
    cells: Tensor
    first_time: Tensor
    time_cells: Tensor

    def __init__(
        self,
        channels: int = 16,
        space_nodes: int = 32,
        time_nodes: int = 50,
        width: int = 32,
        half_extent: float = 1.0,
        time_range: tuple[float, float] = (0.0, 1.0),
    ) -> None:
        super().__init__()
        self.space = nn.Parameter(torch.empty(3, space_nodes, space_nodes, channels).uniform_(*SPACE_INIT))
        self.time = nn.Parameter(torch.ones(3, time_nodes, space_nodes, channels))
        self.register_buffer("cells", torch.tensor((space_nodes - 1) / (2 * half_extent)))  # a scene unit
        first, last = time_range
        self.register_buffer("first_time", torch.tensor(first))
        self.register_buffer("time_cells", torch.tensor((time_nodes - 1) / ((last - first) or 1.0)))  # a unit of time
        self.features = nn.Linear(channels, width)
        self.hidden = nn.ModuleList(nn.Linear(width, width) for _ in HEAD_SIZES)
        self.heads = nn.ModuleList(nn.Linear(width, size) for size in HEAD_SIZES)
        with torch.no_grad():
            for name, parameter in self.heads.named_parameters():
                if name.endswith("bias") or name != f"{len(HEAD_SIZES) - 1}.weight":
                    parameter.zero_()  # a new layer moves nothing; its weight keeps a random direction to learn from

    def forward(self, means: Tensor, t: Tensor) -> LayerStep:
        """The step of means, [N, 3], at time `t`, a scalar tensor of the same dtype and device."""
        positions = means * self.cells + (self.space.shape[1] - 1) / 2
        features = self.features(_PlaneFeatures.apply(self.space, self.lines(t), positions)).relu()
        delta_means, delta_log_scales, delta_quats, logits = (
            head(hidden(features).relu()) for hidden, head in zip(self.hidden, self.heads, strict=True)
        )
        return LayerStep(delta_means, delta_log_scales, delta_quats, logits.sigmoid())

    def lines(self, t: Tensor) -> Tensor:
        """[3, S, C] the planes over time at time `t`; the ends of the range hold beyond them."""
        nodes = self.time.shape[1]
        place = ((t - self.first_time) * self.time_cells).clamp(0, nodes - 1)
        below = place.floor().clamp(max=nodes - 2)
        index = int(below)
        return torch.lerp(self.time[:, index], self.time[:, index + 1], place - below)

    @torch.no_grad()
    def carry_outwards(self, before: float, after: float) -> None:
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

    def roughness(self) -> tuple[Tensor, Tensor]:
        """Mean squared second difference along time, and first difference along the axes of space."""
        bend = self.time[:, 2:] - 2 * self.time[:, 1:-1] + self.time[:, :-2]
        slopes = self.space.diff(dim=1).square().mean() + self.space.diff(dim=2).square().mean()
        return bend.square().mean(), slopes

    def extra_repr(self) -> str:
        return f"{sum(p.numel() for p in self.parameters()):,} parameters"


class _PlaneFeatures(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, space: Tensor, lines: Tensor, positions: Tensor) -> Tensor:
        ctx.save_for_backward(space, lines, positions)
        arrays = [_array(tensor) for tensor in (space, lines, positions)]
        features = np.empty((len(positions), space.shape[3]), arrays[0].dtype)
        run_parallel(plane_features, [(*arrays, a, b, features) for a, b in split_evenly(len(positions), PARTS)])
        return torch.from_numpy(features).to(positions.device)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, ...]:  # type: ignore[override]
        space, lines, positions = (_array(tensor) for tensor in ctx.saved_tensors)
        grad_features, grad_positions = _array(grad), np.empty_like(positions)
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


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().cpu().contiguous().numpy()

"""One step of deformation by motions that many Gaussians share: a time-free weight of each, splines over time.

What moves as one does so by construction, and what is learned of one moment leaves the others as they are, where an
MLP's weights serve all places and times. Motion bases are those of Shape of Motion (Wang et al. 2024), but on splines,
and what moves may stretch: a soft body takes few motions, where rigid ones must be many and each finds its own way.
"""

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from msdgs_serve.scene.quaternion import MIN_NORM
from msdgs_serve.threads import run_parallel, split_evenly
from msdgs_train.layers.mlp import LayerStep, to_array
from msdgs_train.supports.skinning_kernels import DELTAS, K_NEAREST, carry, carry_backward

NODE_MIN_OPACITY = 0.3
"""Opacity from which a Gaussian may be the pivot of a motion."""
NODE_RADIUS = 0.5
"""Standard deviation of a motion's first weights, in distances between pivots."""
MIN_INITIAL_LOGIT = -12.0
"""Of these, at first: little enough, and still enough of a gradient to come back."""
MIN_NODE_RADIUS = 1e-3  # scene units
NEIGHBOURS = 4
SHORTEST = 0.01  # scene units, added to distances between pivots
TURNS_COUNT = 0.3  # scene units that a quaternion's unit is worth, and a stretch by as much again
PARTS = 4  # that the rows are split into; fixed, so that sums have the same order whatever the number of threads


class SkinningInputs(NamedTuple):
    """N canonical Gaussians as motions carry them."""

    means: Tensor  # [N, 3]
    quats: Tensor  # [N, 4] wxyz, unit
    skinning_weights: Tensor  # [N, F] of the motions that each follows; rows sum to 1
    node_ids: Tensor  # [N, F] int64, which of the layer's motions these are

    def rows(self, ids: Tensor | slice) -> "SkinningInputs":
        """Some of them."""
        return SkinningInputs(*(tensor[ids] for tensor in self))


class BasisLayer(nn.Module):
    """B motions, each a stretch, a turn and a shift about a pivot: cubic B-splines of evenly spread knots.

    It moves canonical Gaussians, so it is the first of a chain. Gradients reach the means as they are turned, whatever
    `detach_deform_input` says, which is for layers that read means as places in a field.
    """

    kind = "bases"
    stretches: Tensor
    pivots: Tensor
    neighbours: Tensor
    first_time: Tensor
    time_knots: Tensor

    def __init__(
        self, count: int = 256, knots: int = 36, time_range: tuple[float, float] = (0.0, 1.0), stretching: bool = True
    ) -> None:
        super().__init__()
        first, last = time_range
        self.shifts = nn.Parameter(torch.zeros(knots + 3, count, 3))  # scene units
        self.turns = nn.Parameter(torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(knots + 3, count, 1))  # wxyz, any length
        stretches = torch.zeros(knots + 3, count, 6)  # a symmetric matrix less the identity: xx, yy, zz, xy, xz, yz
        if stretching:
            self.stretches = nn.Parameter(stretches)
        else:
            self.register_buffer("stretches", stretches)
        self.register_buffer("pivots", torch.zeros(count, 3))
        self.register_buffer("neighbours", torch.zeros(count, min(NEIGHBOURS, count - 1), dtype=torch.int64))
        self.register_buffer("first_time", torch.tensor(first))
        self.register_buffer("time_knots", torch.tensor(knots / ((last - first) or 1.0)))  # a unit of time

    def forward(self, carried: SkinningInputs, t: Tensor) -> LayerStep:
        """The step of N Gaussians at time `t`, a scalar tensor of the same dtype and device."""
        means, scales, quats = _Carry.apply(*carried, self.motions(t)).split((3, 3, 4), dim=1)
        return LayerStep(means, scales, quats, means.new_ones(len(means), 1))

    def motions(self, t: Tensor) -> Tensor:
        """[B, 16] at time `t`, as `basis_kernels` has them: matrices, offsets, quaternions."""
        read, part = self.knots_at(t)
        weights = cubic_weights(part)
        shifts, turns, stretches = (torch.einsum("k,kbc->bc", weights, curve[read]) for curve in self._curves)
        turns = _unit(turns)
        matrices = rotation_matrices(turns) @ stretch_matrices(stretches)
        offsets = self.pivots + shifts - torch.einsum("bij,bj->bi", matrices, self.pivots)
        return torch.cat([matrices.flatten(1), offsets, turns], dim=1)

    @property
    def _curves(self) -> tuple[Tensor, Tensor, Tensor]:
        return self.shifts, self.turns, self.stretches

    def knots_at(self, t: Tensor) -> tuple[slice, Tensor]:
        """The four knots that a time reads, and how far it is, in [0, 1], from the second to the third of them."""
        knots = len(self.shifts) - 3
        place = ((t - self.first_time) * self.time_knots).clamp(0, knots)
        first = min(int(place), knots - 1)
        return slice(first, first + 4), place - first

    @torch.no_grad()
    def place(self, means: Tensor, opacities: Tensor) -> tuple[Tensor, Tensor]:
        """Put the pivots among opaque Gaussians, as far apart as can be; returns the motions that each Gaussian
        follows, logits of the weights to begin with and ids, [N, F] both.

        Args:
            means: [N, 3].
            opacities: [N] in (0, 1).
        """
        opaque = means[opacities > NODE_MIN_OPACITY] if bool((opacities > NODE_MIN_OPACITY).any()) else means
        chosen = int((opaque - opaque.mean(dim=0)).norm(dim=1).argmin())
        distances = torch.full((len(opaque),), torch.inf)
        for k in range(len(self.pivots)):
            self.pivots[k] = opaque[chosen]
            distances = torch.minimum(distances, (opaque - opaque[chosen]).norm(dim=1))
            chosen = int(distances.argmax())
        near = torch.cdist(self.pivots, self.pivots).topk(self.neighbours.shape[1] + 1, largest=False)
        self.neighbours.copy_(near.indices[:, 1:])
        reach = max(NODE_RADIUS * float(distances.max()), MIN_NODE_RADIUS)
        logits = -0.5 * (torch.cdist(means, self.pivots) / reach).square()
        nearest = logits.topk(min(K_NEAREST, logits.shape[1]), dim=1)
        return (nearest.values - nearest.values[:, :1]).clamp_min(MIN_INITIAL_LOGIT), nearest.indices

    @torch.no_grad()
    def on_window(self, before: float, after: float) -> None:
        """Go on with what is known when training's time window, around the middle of the range, widens from half a
        width of `before` to `after`, parts of the range.

        Beyond it motions stay where they are, as stretched as they are, and turn on as they turn: a turn has inertia,
        and what falls will bounce; were it expected to fall on, it would be lost under the ground.
        """
        knots = len(self.shifts) - 3
        known = [k for k in range(knots + 3) if abs((k - 1) / knots - 0.5) <= after + 0.5 / knots]
        for last, outwards in ((known[0], -1), (known[-1], 1)):
            turn, inner = (_unit(self.turns[k]) for k in (last, last - outwards))
            step = product(turn, inner * turn.new_tensor([1.0, -1.0, -1.0, -1.0]))
            for k in range(last + outwards, knots + 3 if outwards > 0 else -1, outwards):
                if abs(k - last) <= 3:  # as many as a time within the window reads
                    turn = _unit(product(step, turn))
                self.shifts[k], self.turns[k], self.stretches[k] = self.shifts[last], turn, self.stretches[last]

    def bends(self, t: Tensor) -> Tensor:
        """Mean size of second differences along time of the knots that a time reads; shifts count most."""
        read, _ = self.knots_at(t)
        shifts, turns, stretches = (curve[read].diff(n=2, dim=0).abs().mean() for curve in self._curves)
        return shifts + TURNS_COUNT * (turns + stretches)

    def strains(self, t: Tensor) -> Tensor:
        """Mean distance of where motions and their neighbours carry a pivot, as a part of that between the pivots."""
        matrices, offsets, _ = self.motions(t).split((9, 3, 4), dim=1)
        near = self.neighbours
        own = torch.einsum("bij,bj->bi", matrices.view(-1, 3, 3), self.pivots) + offsets
        carried = torch.einsum("bij,bkj->bki", matrices.view(-1, 3, 3), self.pivots[near]) + offsets[:, None]
        lengths = torch.linalg.vector_norm(self.pivots[near] - self.pivots[:, None], dim=2)
        return (torch.linalg.vector_norm(carried - own[near], dim=2) / (lengths + SHORTEST)).mean()

    def extra_repr(self) -> str:
        return f"{sum(p.numel() for p in self.parameters()):,} parameters"


class _Carry(torch.autograd.Function):
    """Deltas [N, DELTAS] of Gaussians, as `basis_kernels` has them. By matrices of torch a step of training takes 1.14
    times as long."""

    @staticmethod
    def forward(ctx: Any, *tensors: Tensor) -> Tensor:
        ctx.save_for_backward(*tensors)
        arrays = [to_array(tensor) for tensor in tensors]
        deltas = np.empty((len(arrays[0]), DELTAS), arrays[0].dtype)
        run_parallel(carry, [(*arrays, *rows, deltas) for rows in split_evenly(len(deltas), PARTS)])
        return torch.from_numpy(deltas).to(tensors[0].device)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        arrays = means, quats, weights, _, motions = [to_array(tensor) for tensor in ctx.saved_tensors]
        own = [np.empty_like(array) for array in (means, quats, weights)]
        parts = split_evenly(len(means), PARTS) or [(0, 0)]
        sums = np.zeros((len(parts), *motions.shape), motions.dtype)
        pulls = to_array(grad)
        run_parallel(
            carry_backward, [(*arrays, pulls, *rows, *own, part) for rows, part in zip(parts, sums, strict=True)]
        )
        of_means, of_quats, of_weights, of_motions = (
            torch.from_numpy(array).to(grad.device) for array in (*own, sums.sum(axis=0))
        )
        return of_means, of_quats, of_weights, None, of_motions


def cubic_weights(part: Tensor) -> Tensor:
    """[4] of the knots around a time, `part` of the way from the second to the third: a uniform cubic B-spline."""
    u, v = part, 1 - part
    return torch.stack([v**3, 3 * u**3 - 6 * u**2 + 4, 3 * v**3 - 6 * v**2 + 4, u**3]) / 6


def product(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton products of quaternions [N, 4], wxyz: first b turns, then a."""
    (aw, av), (bw, bv) = (q.split((1, 3), dim=1) for q in (a, b))
    vector = aw * bv + bw * av + torch.linalg.cross(av, bv)
    return torch.cat([aw * bw - (av * bv).sum(dim=1, keepdim=True), vector], dim=1)


def rotation_matrices(quats: Tensor) -> Tensor:
    """[N, 3, 3] of unit quaternions [N, 4], wxyz."""
    w, x, y, z = quats.unbind(dim=1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, dim=1) for row in rows], dim=1)


def stretch_matrices(stretches: Tensor) -> Tensor:
    """[N, 3, 3] the identity and symmetric matrices of xx, yy, zz, xy, xz, yz, [N, 6]."""
    xx, yy, zz, xy, xz, yz = stretches.unbind(dim=1)
    rows = ((1 + xx, xy, xz), (xy, 1 + yy, yz), (xz, yz, 1 + zz))
    return torch.stack([torch.stack(row, dim=1) for row in rows], dim=1)


def _unit(quats: Tensor) -> Tensor:
    return quats / torch.linalg.vector_norm(quats, dim=1, keepdim=True).clamp_min(MIN_NORM)

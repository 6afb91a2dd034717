"""Motions as uniform cubic B-splines over time: what layers have in common whose poses are curves.

A gradient at one time changes only nearby knots, while an MLP shares its weights over all positions and times.
"""

from dataclasses import dataclass, replace
from typing import ClassVar, Self

import torch
from torch import Tensor, nn

from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.layers import arrays
from msdgs_train.layers.base import DeformationLayer, LayerConfig, check_size
from msdgs_train.layers.quaternions import conjugate, multiply, unit

NUM_KNOTS, MAX_KNOTS = 36, 120
"""Limits of the intervals that follow the captured times."""


@dataclass(frozen=True)
class CurveConfig(LayerConfig):
    """Size of curves that move control nodes."""

    has_extra_heads: ClassVar[bool] = False
    num_knots: int = 0
    """Intervals of a spline over the time range of the scene; 0: 36, or with fixed cameras one per captured time, if
    that is more, up to 120."""

    def with_knots(self) -> Self:
        """These settings with the number of intervals that 0 stands for."""
        return replace(self, num_knots=self.num_knots or NUM_KNOTS)

    def for_rig(self, num_times: int) -> Self:
        return self if self.num_knots else replace(self, num_knots=min(max(num_times, NUM_KNOTS), MAX_KNOTS))

    def check(self, field: str, moves_nodes: bool) -> None:
        check_size(f"{field}.num_knots", self.num_knots, least=0)
        if not moves_nodes:
            raise InvalidInput(field, "of another kind without --support nodes: it moves control nodes", self.kind)


class CurveLayer(DeformationLayer):
    """C poses over time."""

    first_time: Tensor
    knots_per_time: Tensor

    def __init__(self, num_knots: int, count: int, time_range: tuple[float, float]) -> None:
        super().__init__()
        first, last = time_range
        rows = num_knots + 3
        self.num_knots = num_knots
        self.transls = nn.Parameter(torch.zeros(rows, count, 3))
        self.rots = nn.Parameter(torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(rows, count, 1))  # wxyz, any length
        self.register_buffer("first_time", torch.tensor(first))
        self.register_buffer("knots_per_time", torch.tensor(num_knots / ((last - first) or 1.0)))

    @property
    def held_curves(self) -> tuple[Tensor, ...]:
        """Those that are constant beyond the time window: all but translations and rotations."""
        return ()

    @property
    def rot_lengths(self) -> float | Tensor:
        """Lengths of the quaternions of new knots, one or [C, 1]."""
        return 1.0

    def values_at(self, t: Tensor, *curves: Tensor) -> list[Tensor]:
        """[C, ·] of curves, [knots + 3, C, ·], at one time."""
        read, part = self.knots_at(t)
        weights = cubic_weights(part)
        return [(weights @ curve[read].flatten(1)).unflatten(0, curve.shape[1:]) for curve in curves]

    def unsteadiness(self, t: Tensor, *curves: Tensor) -> list[Tensor]:
        """Mean absolute second difference along time of the four knots around a time, of each curve."""
        read, _ = self.knots_at(t)
        return [curve[read].diff(n=2, dim=0).abs().mean() for curve in curves]

    def knots_at(self, t: Tensor) -> tuple[slice | Tensor, Tensor]:
        """The four knots around a time, as an index, and its position, in [0, 1], between the second and the third of
        them."""
        knots = self.num_knots
        position = ((t - self.first_time) * self.knots_per_time).clamp(0, knots)
        if arrays.has_kernels(position):
            first = min(int(position), knots - 1)
            return slice(first, first + 4), position - first
        below = position.floor().clamp(max=knots - 1)  # stays on the device, which the CPU doesn't wait for
        return below.long() + torch.arange(4, device=position.device), position - below

    @torch.no_grad()
    def on_window(self, before: float, after: float) -> None:
        """Beyond the window, translations and rotations continue at constant speed, and other curves are held.

        With held translations what moves fast is lost: 3.6 dB on mujoco_7 of benchmarks/training/scenes.toml, seed 0.
        """
        knots = self.num_knots
        known = [k for k in range(knots + 3) if abs((k - 1) / knots - 0.5) <= after + 0.5 / knots]
        first, last = known[0], known[-1]
        for curve in self.held_curves:
            curve[:first], curve[last + 1 :] = curve[first], curve[last]
        # of both ends at once, [2, C, 3] and [2 C, 4]
        transls, shifts = torch.stack([self.transls[first], self.transls[last]]), self._speeds(first, last)
        ends = (first, last), (first + 1, last - 1)
        rots, inner = (unit(torch.cat([self.rots[a], self.rots[b]])) for a, b in ends)
        turns = multiply(rots, conjugate(inner))
        for farther in range(3):  # knots that times within the window read; those farther away are as the third
            transls, rots = transls + shifts, unit(multiply(turns, rots))
            for end, beyond in enumerate((slice(0, max(first - farther, 0)), slice(last + 1 + farther, None))):
                self.transls[beyond] = transls[end]
                self.rots[beyond] = self.rot_lengths * rots.unflatten(0, (2, -1))[end]

    def _speeds(self, first: int, last: int) -> Tensor:
        """[2, C, 3] translations per knot, away from the window, at its first and its last knot: the mean over two
        intervals next to these, since the outermost knots have been trained least. 0 while there are too few knots."""
        if last - first < 4:
            return torch.zeros_like(self.transls[:2])
        t = self.transls
        return torch.stack([t[first + 1] - t[first + 3], t[last - 1] - t[last - 3]]) / 2


def cubic_weights(part: Tensor) -> Tensor:
    """[4] weights of the knots around a time, at the fraction `part` between the second and the third."""
    u, v = part, 1 - part
    return torch.stack([v**3, 3 * u**3 - 6 * u**2 + 4, 3 * v**3 - 6 * v**2 + 4, u**3]) / 6

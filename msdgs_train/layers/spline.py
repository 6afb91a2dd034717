"""One step of deformation by splines: each node has its own translation, rotation and stretch over time.

A gradient at one time changes only nearby knots, while an MLP shares its weights over all positions and times. On
control nodes these are Shape of Motion's motion bases (Wang et al. 2024) on splines, with a stretch: a soft body needs
fewer of them than of rigid ones.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor, nn

from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.layers import arrays
from msdgs_train.layers.base import DeformationLayer, Heads, LayerConfig, LayerStep, SceneBounds, check_size
from msdgs_train.layers.parameters import LearningRate, ParamGroup
from msdgs_train.layers.quaternions import identity_like, multiply, unit

NUM_KNOTS, MAX_KNOTS = 36, 120
"""Limits of the intervals that follow the captured times."""
ROTATION_WEIGHT = 0.3
"""Scene units per unit of quaternions and of stretches in temporal smoothness."""


@dataclass(frozen=True)
class SplineConfig(LayerConfig):
    """Sizes and learning rates of a spline layer."""

    kind: ClassVar[str] = "spline"
    has_extra_heads: ClassVar[bool] = False
    num_knots: int = 0
    """Intervals of a spline over the time range of the scene; 0: 36, or with fixed cameras one per captured time, if
    that is more, up to 120."""
    affine: bool = True
    """Nodes have stretch tensors; otherwise their motion is rigid."""
    lr_init: float = 6e-4
    """Learning rate until all times take part."""
    lr_final: float = 6e-5
    """Learning rate at the last step, to which it decays exponentially."""
    motion_smoothness_weight: float = 0.2
    """Weight of the mean size of second differences along time."""

    def build(self, bounds: SceneBounds, heads: Heads, num_points: int | None) -> "SplineLayer":
        assert num_points is not None  # `check` refuses Gaussians
        return SplineLayer(replace(self, num_knots=self.num_knots or NUM_KNOTS), num_points, bounds.time_range)

    def for_rig(self, num_times: int) -> "SplineConfig":
        return self if self.num_knots else replace(self, num_knots=min(max(num_times, NUM_KNOTS), MAX_KNOTS))

    def check(self, field: str, moves_nodes: bool) -> None:
        check_size(f"{field}.num_knots", self.num_knots, least=0)
        if not moves_nodes:
            raise InvalidInput(
                field, "of another kind without --support nodes: each control node has a spline", self.kind
            )


class SplineLayer(DeformationLayer):
    """Uniform cubic B-splines; step weights are 1."""

    kind = "spline"
    stretches: Tensor
    first_time: Tensor
    knots_per_time: Tensor

    def __init__(self, config: SplineConfig, num_points: int, time_range: tuple[float, float]) -> None:
        super().__init__()
        first, last = time_range
        rows, knots = config.num_knots + 3, config.num_knots
        self.config = config
        self.transls = nn.Parameter(torch.zeros(rows, num_points, 3))  # scene units
        self.rots = nn.Parameter(torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(rows, num_points, 1))  # wxyz, any length
        stretches = torch.zeros(rows, num_points, 6)  # a right-stretch tensor less the identity: xx, yy, zz, xy, xz, yz
        if config.affine:
            self.stretches = nn.Parameter(stretches)
        else:
            self.register_buffer("stretches", stretches)
        self.register_buffer("first_time", torch.tensor(first))
        self.register_buffer("knots_per_time", torch.tensor(knots / ((last - first) or 1.0)))

    def forward(self, means: Tensor, t: Tensor) -> LayerStep:
        read, part = self.knots_at(t)
        weights = cubic_weights(part)
        transls, rots, stretches = (torch.einsum("k,kbc->bc", weights, curve[read]) for curve in self._curves)
        return LayerStep(transls, stretches, rots - identity_like(rots), transls.new_ones(len(transls), 1))

    @property
    def _curves(self) -> tuple[Tensor, Tensor, Tensor]:
        return self.transls, self.rots, self.stretches

    def knots_at(self, t: Tensor) -> tuple[slice | Tensor, Tensor]:
        """The four knots around a time, as an index, and its position, in [0, 1], between the second and the third of
        them."""
        knots = self.config.num_knots
        position = ((t - self.first_time) * self.knots_per_time).clamp(0, knots)
        if arrays.has_kernels(position):
            first = min(int(position), knots - 1)
            return slice(first, first + 4), position - first
        below = position.floor().clamp(max=knots - 1)  # stays on the device, which the CPU doesn't wait for
        return below.long() + torch.arange(4, device=position.device), position - below

    def parameter_groups(self) -> list[ParamGroup]:
        lr = LearningRate(self.config.lr_init, self.config.lr_final, holds=True)
        return [ParamGroup("curves", list(self.parameters()), lr)]

    def regularizers(self, points: Tensor, t: Tensor, generator: torch.Generator) -> dict[str, Tensor]:
        return {"motion_smoothness": self.config.motion_smoothness_weight * self.temporal_smoothness(t)}

    def temporal_smoothness(self, t: Tensor) -> Tensor:
        """Mean absolute second difference along time of the four knots around a time; translations count most."""
        read, _ = self.knots_at(t)
        transls, rots, stretches = (curve[read].diff(n=2, dim=0).abs().mean() for curve in self._curves)
        return transls + ROTATION_WEIGHT * (rots + stretches)

    @torch.no_grad()
    def on_window(self, before: float, after: float) -> None:
        """Beyond the window, translations and stretches are held constant and rotations continue at constant speed.

        Extrapolated translations would carry a falling object below the ground before it bounces.
        """
        knots = self.config.num_knots
        known = [k for k in range(knots + 3) if abs((k - 1) / knots - 0.5) <= after + 0.5 / knots]
        for last, direction in ((known[0], -1), (known[-1], 1)):
            rot, inner = (unit(self.rots[k]) for k in (last, last - direction))
            step = multiply(rot, inner * rot.new_tensor([1.0, -1.0, -1.0, -1.0]))
            beyond = slice(last + 1, None) if direction > 0 else slice(0, last)
            turned = range(knots + 3)[beyond][::direction][:3]  # knots that times within the window read
            rots = [rot := unit(multiply(step, rot)) for _ in turned]
            self.transls[beyond], self.stretches[beyond] = self.transls[last], self.stretches[last]
            self.rots[beyond] = rot
            for k, each in zip(turned, rots, strict=True):
                self.rots[k] = each

    def operations(self) -> int:
        """0: curves are evaluated once per frame."""
        return 0


def cubic_weights(part: Tensor) -> Tensor:
    """[4] weights of the knots around a time, at the fraction `part` between the second and the third."""
    u, v = part, 1 - part
    return torch.stack([v**3, 3 * u**3 - 6 * u**2 + 4, 3 * v**3 - 6 * v**2 + 4, u**3]) / 6

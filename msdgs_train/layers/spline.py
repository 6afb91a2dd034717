"""One step of deformation by splines: each node has its own translation, rotation and stretch over time.

On control nodes these are Shape of Motion's motion bases (Wang et al. 2024) on splines, with a stretch: a soft body
needs fewer of them than of rigid ones.
"""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

from msdgs_train.layers.base import Heads, LayerStep, SceneBounds
from msdgs_train.layers.curves import CurveConfig, CurveLayer
from msdgs_train.layers.parameters import LearningRate, ParamGroup
from msdgs_train.layers.quaternions import identity_like

ROTATION_WEIGHT = 0.3
"""Scene units per unit of quaternions and of stretches in temporal smoothness."""


@dataclass(frozen=True)
class SplineConfig(CurveConfig):
    """Sizes and learning rates of a spline layer."""

    kind: ClassVar[str] = "spline"
    affine: bool = True
    """Nodes have stretch tensors; otherwise their motion is rigid."""
    lr_init: float = 6e-4
    """Learning rate until all times take part."""
    lr_final: float = 6e-5
    """Learning rate at the last step, to which it decays exponentially."""
    motion_smoothness_weight: float = 0.2
    """Weight of the mean size of second differences along time."""
    shading: bool = False
    """Nodes scale colors over time: shading that changes as objects turn, and soft shadows. Only plans that run layers
    can hold such a model."""
    shading_lr_init: float = 2e-3
    """Learning rate of these gains until all times take part."""
    shading_lr_final: float = 2e-4
    """Learning rate of these gains at the last step."""
    shading_smoothness_weight: float = 0.02
    """Weight of the mean size of their second differences along time."""

    def build(self, bounds: SceneBounds, heads: Heads, num_points: int | None) -> "SplineLayer":
        assert num_points is not None  # `check` refuses Gaussians
        return SplineLayer(self.with_knots(), num_points, bounds.time_range)


class SplineLayer(CurveLayer):
    """Uniform cubic B-splines; step weights are 1. Translations are in scene units."""

    kind = "spline"
    stretches: Tensor
    gains: nn.Parameter | None

    def __init__(self, config: SplineConfig, num_points: int, time_range: tuple[float, float]) -> None:
        super().__init__(config.num_knots, num_points, time_range)
        self.config = config
        # a right-stretch tensor less the identity: xx, yy, zz, xy, xz, yz
        stretches = torch.zeros(config.num_knots + 3, num_points, 6)
        if config.affine:
            self.stretches = nn.Parameter(stretches)
        else:
            self.register_buffer("stretches", stretches)
        self.gains = nn.Parameter(torch.zeros(config.num_knots + 3, num_points, 3)) if config.shading else None

    @property
    def shades(self) -> bool:
        return self.gains is not None

    @property
    def held_curves(self) -> tuple[Tensor, ...]:
        return self.stretches, *self._shading

    @property
    def _shading(self) -> tuple[Tensor, ...]:
        return () if self.gains is None else (self.gains,)

    def forward(self, means: Tensor, t: Tensor) -> LayerStep:
        transls, rots, stretches, *gains = self.values_at(t, self.transls, self.rots, self.stretches, *self._shading)
        ones = transls.new_ones(len(transls), 1)
        return LayerStep(transls, stretches, rots - identity_like(rots), ones, gains=gains[0] if gains else None)

    def parameter_groups(self) -> list[ParamGroup]:
        c = self.config
        curves = [parameter for parameter in self.parameters() if parameter is not self.gains]
        groups = [ParamGroup("curves", curves, LearningRate(c.lr_init, c.lr_final, holds=True))]
        if self.gains is not None:
            rate = LearningRate(c.shading_lr_init, c.shading_lr_final, holds=True)
            groups.append(ParamGroup("gains", [self.gains], rate))
        return groups

    def regularizers(self, points: Tensor, t: Tensor, generator: torch.Generator) -> dict[str, Tensor]:
        terms = {"motion_smoothness": self.config.motion_smoothness_weight * self.temporal_smoothness(t)}
        if self.gains is not None:
            (unsteadiness,) = self.unsteadiness(t, self.gains)
            terms["shading_smoothness"] = self.config.shading_smoothness_weight * unsteadiness
        return terms

    def temporal_smoothness(self, t: Tensor) -> Tensor:
        """Mean absolute second difference along time of the four knots around a time; translations count most."""
        transls, rots, stretches = self.unsteadiness(t, self.transls, self.rots, self.stretches)
        return transls + ROTATION_WEIGHT * (rots + stretches)

    def operations(self) -> int:
        """0: curves are evaluated once per frame."""
        return 0

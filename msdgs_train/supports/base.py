"""The interface of a support: which points a chain of layers moves, and how these carry the Gaussians."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import torch
from torch import Tensor, nn

from msdgs_train.layers.chain import Deltas, MultiStepDeformation
from msdgs_train.layers.parameters import LearningRate, Role

if TYPE_CHECKING:
    from msdgs_train.gaussians.canonical import CanonicalGaussians
    from msdgs_train.gaussians.surgery import RowSurgery


class Attribute(NamedTuple):
    """A column of numbers that is stored per Gaussian, besides its shape, opacity and color."""

    columns: int
    init: Callable[[int, int, torch.Generator], Tensor]  # of rows, columns and a generator; integers aren't trained
    lr: LearningRate
    role: Role


class CanonicalPoints(NamedTuple):
    """N canonical Gaussians as a support reads them."""

    means: Tensor  # [N, 3]
    quats: Tensor  # [N, 4] wxyz, unit
    attributes: dict[str, Tensor]  # the support's own, of N rows


@dataclass(frozen=True)
class SupportConfig:
    """Sizes and learning rates of a support."""

    kind: ClassVar[str]
    moves_nodes: ClassVar[bool] = False
    """Whether layers move control nodes, whose scale deltas are stretches, instead of Gaussians."""

    def build(self) -> "Support":
        """A new support."""
        raise NotImplementedError

    def check(self, field: str) -> None:
        """Raise `InvalidInput` naming `field.SETTING` where a size is out of range."""

    def attributes(self) -> dict[str, Attribute]:
        """What is stored per Gaussian, by name."""
        return {}


class Support(nn.Module):
    """Runs a chain of layers on its points. It knows nothing of the kinds of layers."""

    kind: ClassVar[str]
    num_points: int | None = None
    """Of control nodes; None if the points are the Gaussians themselves."""

    def forward(
        self, chain: MultiStepDeformation, gaussians: CanonicalPoints, t: Tensor, num_layers: int | None
    ) -> Deltas:
        """What Gaussians change by at time `t`, a scalar tensor, after `num_layers` of the chain, or all."""
        raise NotImplementedError

    def points(self, gaussians: CanonicalPoints) -> Tensor:
        """[M, 3] where the chain's points are before any layer."""
        raise NotImplementedError

    def on_deform_start(self, gaussians: "CanonicalGaussians", surgery: "RowSurgery") -> None:
        """Before the first step in which the deformation takes part."""

    def regularizers(self, chain: MultiStepDeformation, t: Tensor) -> dict[str, Tensor]:
        """Weighted terms of the loss at time `t`, by name."""
        return {}

    def baked(self, attributes: dict[str, Tensor]) -> dict[str, Any]:
        """Arrays of N rows that a scene file stores per Gaussian, of the support's own attributes."""
        return {}

    def spread(self, values: Tensor, attributes: dict[str, Tensor]) -> Tensor:
        """Numbers of the points, [P], as numbers of the Gaussians, [N], that follow them."""
        return values

    def operations(self) -> int:
        """Floating-point operations per Gaussian, besides those of the chain."""
        return 0

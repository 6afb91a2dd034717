"""The interface of a support: which points a chain of layers moves, and how the Gaussians follow these points."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor, nn

from msdgs_train.gaussians.attribute import Attribute
from msdgs_train.gaussians.canonical import CanonicalGaussians
from msdgs_train.gaussians.scale_space import ScaleSpace
from msdgs_train.gaussians.surgery import RowSurgery
from msdgs_train.layers.chain import Deltas, MultiStepDeformation
from msdgs_train.layers.parameters import ParamGroup


class CanonicalPoints(NamedTuple):
    """The attributes of N canonical Gaussians that a support reads."""

    means: Tensor  # [N, 3]
    quats: Tensor  # [N, 4] wxyz, unit
    attributes: dict[str, Tensor]  # the support's own, of N rows
    raw_quats: Tensor  # [N, 4] wxyz, of any norm


@dataclass(frozen=True)
class SupportConfig:
    """Sizes and learning rates of a support."""

    kind: ClassVar[str]
    moves_nodes: ClassVar[bool] = False
    """Whether layers move control nodes instead of Gaussians."""
    scale_spaces: ClassVar[tuple[ScaleSpace, ...]] = ("log", "linear")
    """The spaces in which its deltas of scales can be."""
    extra_heads: ClassVar[Mapping[str, int]] = MappingProxyType({})
    """Outputs that each layer predicts besides those of Gaussians: columns by name."""

    def build(self) -> "Support":
        """A new support."""
        raise NotImplementedError

    def check(self, field: str) -> None:
        """Raise `InvalidInput` naming `field.SETTING` if a size is out of range."""

    def attributes(self) -> dict[str, Attribute]:
        """Attributes stored per Gaussian, by name."""
        return {}


class Support(nn.Module):
    """Runs a chain of layers on its points. It knows nothing of the kinds of layers."""

    kind: ClassVar[str]
    num_points: int | None = None
    """Number of control nodes; None if the points are the Gaussians themselves."""

    def check_attributes(self, attributes: dict[str, Tensor]) -> None:
        """Raise `InvalidInput` naming an attribute, of those that `SupportConfig.attributes` names, that can't be
        used."""

    def forward(
        self, chain: MultiStepDeformation, gaussians: CanonicalPoints, t: Tensor, num_layers: int | None = None
    ) -> Deltas:
        """Deltas of the Gaussians at time `t`, a scalar tensor, after the first `num_layers` of the chain, or all."""
        return self.follow(gaussians, self.motions(chain, gaussians.means, t, num_layers))

    def motions(self, chain: MultiStepDeformation, means: Tensor, t: Tensor, num_layers: int | None = None) -> Any:
        """The motions of the points at time `t`, which `follow` and `regularizers` read; `means`, [N, 3], are those of
        the canonical Gaussians."""
        raise NotImplementedError

    def follow(self, gaussians: CanonicalPoints, motions: Any) -> Deltas:
        """Deltas of the Gaussians, given the motions of the points."""
        raise NotImplementedError

    def points(self, means: Tensor) -> Tensor:
        """[M, 3] canonical positions of the points that the chain moves, given canonical means, [N, 3]."""
        raise NotImplementedError

    def parameter_groups(self) -> list[ParamGroup]:
        """All trainable parameters of its own, each in one group, with their learning rates."""
        return []

    def on_deform_start(self, gaussians: CanonicalGaussians, surgery: RowSurgery) -> None:
        """Called before the first step with deformation."""

    def regularizers(
        self, motions: Any, gaussians: CanonicalPoints, t: Tensor, generator: torch.Generator
    ) -> dict[str, Tensor]:
        """Weighted terms of the loss, by name, given the motions at time `t`; all randomness is the generator's, which
        is on the CPU."""
        return {}

    def baked(self, gaussians: CanonicalPoints) -> dict[str, Any]:
        """Arrays [N, …] that a scene file stores per Gaussian, made from the support's attributes."""
        return {}

    def spread(self, values: Tensor, gaussians: CanonicalPoints) -> Tensor:
        """Numbers of the points, [P], as numbers of the Gaussians, [N], that follow them."""
        return values

    def transforms(self, deltas: Deltas) -> Any:
        """The motions of control nodes, given their deltas."""
        raise NotImplementedError

    def mean_error_bounds(self, errors: Tensor, deltas: Deltas, gaussians: CanonicalPoints) -> Tensor:
        """[N] bounds to first order of the errors of the Gaussians' means, given those of the control nodes' deltas.

        Args:
            errors: [P, 3 + E] norms of the errors of means, of scales or stretch tensors (Frobenius), of quaternions,
                and of each extra head.
            deltas: Those of the P nodes.
            gaussians: N canonical Gaussians.
        """
        raise NotImplementedError

    def operations(self) -> int:
        """Floating-point operations per Gaussian, besides those of the chain."""
        return 0

"""The support `gaussians`: the chain moves every Gaussian, as in the paper."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from msdgs_train.layers.chain import Deltas, MultiStepDeformation
from msdgs_train.supports.base import CanonicalPoints, Support, SupportConfig

CHUNK = 4096
"""Gaussians per chunk without gradients, so that activations stay in a core's cache: 1.3 times as fast in float32 and
1.2 times in float64 at 106,500 Gaussians, K = 10 and width 256."""


@dataclass(frozen=True)
class GaussiansConfig(SupportConfig):
    """Settings of the support `gaussians`."""

    kind: ClassVar[str] = "gaussians"
    detach_deform_input: bool = True
    """Photometric gradients through the layers' input don't reach the canonical means, as in DeformGS."""

    def build(self) -> "GaussiansSupport":
        return GaussiansSupport(self)


class GaussiansSupport(Support):
    """The points are the canonical means."""

    kind = "gaussians"

    def __init__(self, config: GaussiansConfig) -> None:
        super().__init__()
        self.config = config

    def motions(self, chain: MultiStepDeformation, means: Tensor, t: Tensor, num_layers: int | None = None) -> Deltas:
        means = self.points(means)
        if torch.is_grad_enabled() or len(means) <= CHUNK:
            return chain(means, t, num_layers)
        return Deltas.joined([chain(chunk, t, num_layers) for chunk in means.split(CHUNK)])

    def follow(self, gaussians: CanonicalPoints, motions: Deltas) -> Deltas:
        return motions

    def points(self, means: Tensor) -> Tensor:
        return means.detach() if self.config.detach_deform_input else means

"""Density control under a budget (3D Gaussian Splatting as Markov Chain Monte Carlo, Kheradmand et al. 2024).

Low-opacity Gaussians are relocated to opaque ones, and new ones are added there until the budget is reached. Opacity
and scales of a Gaussian and its copies are reduced so that the image doesn't change. Noise is injected into the means.

The formulas and constants are those of gsplat's `MCMCStrategy`, which itself runs on CUDA only.
"""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from msdgs_train.density.strategy import DensityStrategy
from msdgs_train.engine.schedule import Schedule
from msdgs_train.gaussians.canonical import CanonicalGaussians
from msdgs_train.gaussians.surgery import RowSurgery
from msdgs_train.layers.arrays import to_device
from msdgs_train.layers.quaternions import identity_like, rotate

GROWTH = 1.05
"""Factor by which the number of Gaussians grows per round, up to the budget."""
MAX_COPIES = 51
"""Upper bound of the number of copies in the formulas."""
MAX_OPACITY = 1 - torch.finfo(torch.float32).eps
NOISE_SLOPE = 100.0
"""Slope of the sigmoid that gates noise by opacity, around `prune_opa`."""


class Relocated(NamedTuple):
    """Numbers of Gaussians relocated and added in one round."""

    moved: int
    added: int


class MCMCStrategy(DensityStrategy):
    """Periodically relocates low-opacity Gaussians and adds new ones, never more than `max_gaussians` in all."""

    @classmethod
    def start(cls, schedule: Schedule, max_gaussians: int) -> "MCMCStrategy":
        """A new strategy, with a generator of its own."""
        return cls(schedule, torch.Generator().manual_seed(schedule.config.run.seed + 1), max_gaussians)

    def after_step(self, surgery: RowSurgery, steps: range) -> None:
        """Relocate if a round is due, then inject noise in proportion to the learning rate of means."""
        if any(map(self.schedule.refines_at, steps)):
            self.relocate(surgery)
        self.inject_noise(surgery.gaussians, surgery.learning_rate("means"))

    @torch.no_grad()
    def relocate(self, surgery: RowSurgery) -> Relocated:
        """Relocate low-opacity Gaussians, and add new ones within the budget, at others drawn by opacity."""
        gaussians = surgery.gaussians
        opacities = gaussians.raw_opacities.double().sigmoid()
        alive = torch.nonzero(opacities > self.config.prune_opa)[:, 0]
        count = len(opacities)
        added = max(0, min(self.max_gaussians, int(GROWTH * count)) - count)
        moved = count - len(alive)
        if moved + added == 0 or len(alive) == 0:  # a scene that is wholly transparent may recover
            return Relocated(0, 0)
        weights = opacities[alive].cpu()
        drawn = torch.multinomial(weights, moved + added, replacement=True, generator=self.generator)
        sources = alive[drawn.to(alive.device)]
        copies = torch.bincount(sources, minlength=count)
        shared = torch.nonzero(copies)[:, 0]
        new_opacities, shrink = compute_relocation(opacities[shared], copies[shared] + 1)
        new_opacities = new_opacities.clamp(self.config.prune_opa, MAX_OPACITY)
        gaussians.raw_opacities[shared] = torch.logit(new_opacities).to(gaussians.raw_opacities)
        gaussians.log_scales[shared] += shrink.log()[:, None].to(gaussians.log_scales)
        surgery.reset_moments(shared)
        surgery.replace_rows(alive, {name: p[sources] for name, p in gaussians.named_parameters()})
        return Relocated(moved, added)

    @torch.no_grad()
    def inject_noise(self, gaussians: CanonicalGaussians, rate: float) -> None:
        """Add noise with the covariance of each Gaussian to its mean, more at lower opacity (equation 9 there)."""
        gate = torch.sigmoid(-NOISE_SLOPE * (gaussians.raw_opacities.sigmoid() - self.config.prune_opa))
        noise = to_device(torch.randn(len(gaussians), 3, generator=self.generator), gate.device)
        quats = functional.normalize(gaussians.raw_quats, dim=1)
        inverse = 2 * quats * identity_like(quats) - quats
        shaped = rotate(quats, gaussians.log_scales.exp().square() * rotate(inverse, noise))  # Σ times the noise
        gaussians.means.add_((rate * self.config.noise_lr * gate)[:, None] * shaped)


def compute_relocation(opacities: Tensor, shares: Tensor) -> tuple[Tensor, Tensor]:
    """Return opacity and scale factor of each of `shares` equal Gaussians that together look like one; float64.

    Args:
        opacities: [N] of the one, in (0, 1).
        shares: [N] int, 1 or more.

    Returns:
        Opacities [N], 1 − (1 − o)^(1/n), with the transmittance of the one at its center; and factors of the scales,
        [N], which keep the sum of alpha along a line through the center: o / Σ_k C(n, k+1) (−1)^k o_n^(k+1) / √(k+1),
        the double sum of the paper's equation 9 with its inner sum of binomials done.
    """
    opacities = opacities.clamp(max=MAX_OPACITY)  # the sum cancels if its terms are large
    shares = shares.clamp(1, MAX_COPIES).double()
    new = -torch.expm1(torch.log1p(-opacities) / shares)
    terms = torch.arange(1, MAX_COPIES + 1, dtype=torch.float64, device=new.device)
    binomials = torch.exp(
        torch.lgamma(shares + 1)[:, None]
        - torch.lgamma(terms + 1)
        - torch.lgamma((shares[:, None] - terms + 1).clamp_min(1))
    )
    binomials = torch.where(terms <= shares[:, None], binomials, 0.0)
    signs = 1 - 2 * ((terms - 1) % 2)
    total = (signs * binomials * new[:, None] ** terms / terms.sqrt()).sum(dim=1)
    return new, opacities / total

"""Density control under a budget (3D Gaussian Splatting as Markov Chain Monte Carlo, Kheradmand et al. 2024).

Low-opacity Gaussians are relocated to opaque ones, and new ones are added there until the budget is reached. A Gaussian
and its copies share its opacity and footprint, so that the image stays. Noise is injected into low-opacity ones.

The formulas and constants are those of gsplat's `MCMCStrategy`, which itself runs on CUDA only.
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from msdgs_train.density.config import DensityConfig
from msdgs_train.engine.schedule import Schedule
from msdgs_train.gaussians.canonical import CanonicalGaussians
from msdgs_train.gaussians.model import PosedGaussians
from msdgs_train.gaussians.surgery import RowSurgery
from msdgs_train.layers.quaternions import rotate

GROWTH = 1.05
"""How many there may be after a round for one before, as long as the budget allows it."""
MAX_COPIES = 51
"""A Gaussian with more copies is divided as if by so many."""
MAX_OPACITY = 1 - torch.finfo(torch.float32).eps
NOISE_SLOPE = 100.0
"""How sharply noise ends above `prune_opa`."""


class Relocated(NamedTuple):
    """How many low-opacity Gaussians one round has relocated, and how many it has added."""

    moved: int
    added: int


@dataclass
class MCMCStrategy:
    """Periodically relocates low-opacity Gaussians and adds new ones, never more than `max_gaussians` in all."""

    schedule: Schedule
    generator: torch.Generator

    @classmethod
    def start(cls, schedule: Schedule) -> "MCMCStrategy":
        """With its own randomness, of the settings' seed."""
        return cls(schedule, torch.Generator().manual_seed(schedule.config.run.seed + 1))

    def accumulate(self, means2d_grads: Tensor, radii: Tensor, width: int, height: int) -> None:
        """Gradients don't matter here."""

    def reset(self, count: int) -> None:
        """Nothing was accumulated."""

    def state(self) -> tuple[Tensor, ...]:
        """Nothing but the generator."""
        return ()

    def load_state(self, state: tuple[Tensor, ...]) -> None:
        """Nothing."""

    @property
    def config(self) -> DensityConfig:
        """The settings."""
        return self.schedule.config.density

    def regularizers(self, posed: PosedGaussians) -> dict[str, Tensor]:
        """Few and small Gaussians: what isn't needed becomes transparent and is relocated."""
        c = self.config
        return {"opacity": c.opacity_reg * posed.opacities.mean(), "scale": c.scale_reg * posed.scales.mean()}

    def after_step(self, surgery: RowSurgery, step: int) -> None:
        """A round when one is due; and noise in proportion to the learning rate of the means."""
        if self.schedule.refines_at(step):
            self.relocate(surgery, step)
        self.inject_noise(surgery.gaussians, surgery.learning_rate("means"))

    @torch.no_grad()
    def relocate(self, surgery: RowSurgery, step: int) -> Relocated:
        """Put low-opacity Gaussians, and what the budget has room for, at others, drawn by their opacity."""
        gaussians = surgery.gaussians
        opacities = gaussians.raw_opacities.double().sigmoid()
        alive = torch.nonzero(opacities > self.config.prune_opa)[:, 0]
        count = len(opacities)
        added = max(0, min(self.schedule.max_gaussians(step), int(GROWTH * count)) - count)
        moved = count - len(alive)
        if moved + added == 0 or len(alive) == 0:  # a scene of which all is transparent may recover
            return Relocated(0, 0)
        drawn = torch.multinomial(opacities[alive], moved + added, replacement=True, generator=self.generator)
        sources = alive[drawn]
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
        """Move each mean by noise of the shape of its covariance, more at lower opacity (equation 9 there)."""
        gate = torch.sigmoid(-NOISE_SLOPE * (gaussians.raw_opacities.sigmoid() - self.config.prune_opa))
        noise = torch.randn(len(gaussians), 3, generator=self.generator)
        quats = functional.normalize(gaussians.raw_quats, dim=1)
        inverse = quats * quats.new_tensor([1.0, -1.0, -1.0, -1.0])
        shaped = rotate(quats, gaussians.log_scales.exp().square() * rotate(inverse, noise))  # Σ times the noise
        gaussians.means.add_((rate * self.config.noise_lr * gate)[:, None] * shaped)


def compute_relocation(opacities: Tensor, shares: Tensor) -> tuple[Tensor, Tensor]:
    """What each of `shares` equal Gaussians in one place is, that together look as one; float64.

    Args:
        opacities: [N] of the one, in (0, 1).
        shares: [N] int, 1 or more.

    Returns:
        Opacities [N], 1 − (1 − o)^(1/n), with which they let as much through at their centre as the one; and [N] by
        what their scales are to be multiplied, so that their alpha, summed along a line through the centre, is the
        same too: o / Σ_k C(n, k+1) (−1)^k o_n^(k+1) / √(k+1), the double sum of the paper's equation 9 with its
        inner sum of binomials done.
    """
    opacities = opacities.clamp(max=MAX_OPACITY)  # the sum loses its digits where all of its terms are large
    shares = shares.clamp(1, MAX_COPIES).double()
    new = -torch.expm1(torch.log1p(-opacities) / shares)
    terms = torch.arange(1, MAX_COPIES + 1, dtype=torch.float64)
    binomials = torch.exp(
        torch.lgamma(shares + 1)[:, None]
        - torch.lgamma(terms + 1)
        - torch.lgamma((shares[:, None] - terms + 1).clamp_min(1))
    )
    binomials = torch.where(terms <= shares[:, None], binomials, 0.0)
    signs = 1 - 2 * ((terms - 1) % 2)
    total = (signs * binomials * new[:, None] ** terms / terms.sqrt()).sum(dim=1)
    return new, opacities / total

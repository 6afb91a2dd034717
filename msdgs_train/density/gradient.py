"""Adaptive density control of 3D Gaussian Splatting (Kerbl et al. 2023, section 5.2), on the canonical Gaussians.

Gradients are those of the projected means of posed Gaussians; the canonical attributes are cloned, split, reset and
removed.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from msdgs_serve.scene import Camera
from msdgs_train.density.strategy import DensityStrategy
from msdgs_train.engine.schedule import Schedule
from msdgs_train.gaussians.bounds import pixel_sizes
from msdgs_train.gaussians.canonical import CanonicalGaussians
from msdgs_train.gaussians.surgery import RowSurgery
from msdgs_train.layers.quaternions import rotate
from msdgs_train.rendering.info import RasterizationInfo

SPLIT_SHRINK = 1.6
"""Scales of the two halves of a split Gaussian are divided by this factor."""
RESET_OPACITY = 0.01
MIN_PATIENCE = 40
"""A pass over fewer cameras counts as this many images, since images are drawn at random."""


class DensityChange(NamedTuple):
    """Numbers of Gaussians cloned, split in two and removed in one round."""

    cloned: int
    split: int
    pruned: int


@dataclass
class GradientStrategy(DensityStrategy):
    """Accumulates gradients over many images and periodically adds and removes Gaussians."""

    scene_scale: float  # of the cameras' positions or of the scene, scene units
    gradients: Tensor  # [N] sums of norms
    counts: Tensor  # [N] images in which each was drawn
    unseen: Tensor  # [N] images since each was seen; infinite once it was outside of the whole scene
    patience: float  # images after which a Gaussian that none shows is removed; 0: never
    cameras: Sequence[Camera]  # of the training images, each pose once
    is_rig: bool  # cameras that stand still: a time window has images of all of them

    @classmethod
    def start(
        cls,
        schedule: Schedule,
        max_gaussians: int,
        scene_scale: float,
        count: int,
        cameras: Sequence[Camera],
        is_rig: bool,
    ) -> "GradientStrategy":
        """A new strategy for `count` Gaussians."""
        patience = schedule.config.density.prune_unseen_passes * max(len(cameras), MIN_PATIENCE)
        generator = torch.Generator().manual_seed(schedule.config.run.seed + 1)
        gradients, counts, unseen = torch.zeros(3, count, device=schedule.config.run.device)
        return cls(
            schedule, generator, max_gaussians, scene_scale, gradients, counts, unseen, patience, cameras, is_rig
        )

    def accumulate(self, screen: RasterizationInfo, width: int, height: int, shows_all: bool) -> None:
        """Accumulate one view, which shows the Gaussians that have a gradient."""
        grads, drawn = screen.means2d_grads, screen.radii > 0
        if grads is None:
            return
        norms = torch.hypot(grads[:, 0] * (0.5 * width), grads[:, 1] * (0.5 * height))
        self.gradients += torch.where(drawn, norms, 0.0)
        self.counts += drawn
        if self.patience:
            self.unseen = torch.where((norms > 0) & self.unseen.isfinite(), 0.0, self.unseen + 1)
            if shows_all:
                self.unseen.masked_fill_(~drawn, torch.inf)

    def after_step(self, surgery: RowSurgery, steps: range) -> None:
        """`densify` and `reset_opacities` when they are due."""
        if self.patience and not self.is_rig and self.schedule.is_windowed(steps.stop - 1):
            self.unseen.masked_fill_(
                self.unseen.isfinite(), 0.0
            )  # images outside the window may show what those inside don't
        if any(map(self.schedule.refines_at, steps)):
            self.densify(surgery, steps[-1])
        if any(map(self.schedule.resets_at, steps)):
            self.reset_opacities(surgery)

    def state(self) -> tuple[Tensor, ...]:
        """The accumulated gradients."""
        return self.gradients, self.counts, self.unseen

    def load_state(self, state: tuple[Tensor, ...]) -> None:
        """Continue from it."""
        self.gradients, self.counts, self.unseen = (tensor.to(self.gradients.device) for tensor in state)

    def densify(self, surgery: RowSurgery, step: int) -> DensityChange:
        """Clone small and split large Gaussians of large gradients, remove low-opacity and huge ones, and reset."""
        gaussians = surgery.gaussians
        with torch.no_grad():
            sizes = gaussians.log_scales.exp().amax(dim=1)
            hidden = self._hidden(gaussians, sizes)
            chosen, large = self._to_densify(hidden), sizes > self.config.grow_scale3d * self.scene_scale
            pruned = self._to_prune(hidden, torch.where(chosen & large, sizes / SPLIT_SHRINK, sizes), step)
            chosen &= ~pruned
            cloned, split = (torch.nonzero(m)[:, 0] for m in (chosen & ~large, chosen & large))
            halves = self._halves(gaussians, split.repeat(2))
            added = {name: torch.cat([p[cloned], halves[name]]) for name, p in gaussians.named_parameters()}
            kept = torch.nonzero(~pruned & ~(chosen & large))[:, 0]
            surgery.replace_rows(kept, added)
        count = len(cloned) + 2 * len(split)
        self.unseen = torch.cat([self.unseen[kept], self.unseen.new_zeros(count)])
        self.gradients, self.counts = self.unseen.new_zeros(2, len(kept) + count)
        return DensityChange(len(cloned), len(split), int(pruned.sum()))

    def reset_opacities(self, surgery: RowSurgery) -> None:
        """Clamp all opacities to 0.01: Gaussians that the images need recover, the rest is pruned."""
        ceiling = math.log(RESET_OPACITY / (1 - RESET_OPACITY))
        surgery.replace_values("raw_opacities", surgery.gaussians.raw_opacities.detach().clamp(max=ceiling))

    def _hidden(self, gaussians: CanonicalGaussians, sizes: Tensor) -> Tensor:
        """[N] bool: of low opacity, unseen for too long, or far smaller than a pixel."""
        hidden = gaussians.raw_opacities.sigmoid() < self.config.prune_opa
        if self.config.prune_subpixel:
            hidden |= sizes < self.config.prune_subpixel * pixel_sizes(gaussians.means, self.cameras)
        if self.patience:
            hidden |= self.unseen > self.patience
        if bool(hidden.all()):  # a scene that is wholly transparent keeps its Gaussians and may recover
            return torch.zeros_like(hidden)
        return hidden

    def _to_prune(self, hidden: Tensor, sizes: Tensor, step: int) -> Tensor:
        """[N] bool: hidden ones, and after a reset huge ones, unless that were all. `sizes`, [N] in scene units, are
        those after a split, which comes first."""
        if not self.schedule.has_reset(step):
            return hidden
        pruned = hidden | (sizes > self.config.prune_scale3d * self.scene_scale)
        return hidden if bool(pruned.all()) else pruned

    def _to_densify(self, hidden: Tensor) -> Tensor:
        """[N] bool: large gradients, the largest first up to the maximum number."""
        mean = (self.gradients / self.counts.clamp(min=1)).masked_fill(hidden, 0.0)
        chosen = mean >= self.config.grow_grad2d
        room = self.max_gaussians - int((~hidden).sum())
        if int(chosen.sum()) > room:
            strongest = torch.sort(mean, descending=True, stable=True).indices[: max(room, 0)]
            chosen = torch.zeros_like(chosen).index_fill_(0, strongest, True)
        return chosen

    def _halves(self, gaussians: CanonicalGaussians, rows: Tensor) -> dict[str, Tensor]:
        """Smaller copies of the given rows, at positions drawn from the Gaussian that is split."""
        values = {name: p[rows] for name, p in gaussians.named_parameters()}
        noise = torch.randn(len(rows), 3, generator=self.generator).to(rows.device) * values["log_scales"].exp()
        values["means"] = values["means"] + rotate(functional.normalize(values["raw_quats"], dim=1), noise)
        values["log_scales"] = values["log_scales"] - math.log(SPLIT_SHRINK)
        return values

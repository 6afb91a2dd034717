"""Pruning: rule by rule, each measured in frames of what all rules before it have left."""

import math
from collections.abc import Callable, Collection
from typing import Any, NamedTuple

from export.layers import export_of
from export.pruning.mask import PrunedModel, PruningMask, full_mask, pruned
from export.pruning.rules import RULES
from export.pruning.statistics import PruningStatistics
from msdgs_serve.scene.spherical_harmonics import sh_coefficients
from msdgs_train.gaussians.model import DynamicGaussians

POSE_BYTES, OPACITY_BYTES, COLOR_BYTES = 40, 4, 12
MOVING_BYTES, MODULATION_BYTES = 8, 12
"""Per Gaussian in a scene file: pose, opacity, an SH coefficient; and if it moves, its id and its modulation."""


class PrunedPart(NamedTuple):
    """What one rule has left out."""

    rule: str
    what: str
    count: int
    of: int
    bytes_saved: int
    worst_frame_db: float  # PSNR of the worst deciding frame, all rules so far together

    def __str__(self) -> str:
        saved = f"{self.bytes_saved / 1e3:,.0f} kB saved" if self.bytes_saved else "no bytes saved"
        return f"{self.what}: {self.count:,} of {self.of:,}, {saved}, worst frame {self.worst_frame_db:.1f} dB"


def prune(
    statistics: PruningStatistics,
    min_db: float,
    rules: Collection[str] = tuple(RULES),
    on_rule: Callable[[], object] = lambda: None,
) -> tuple[PruningMask, list[PrunedPart]]:
    """What `rules` leave of the model while the worst deciding frame stays at `min_db` dB or more.

    Each rule may spend its part of the squared error that this allows, and what the rules before it have not spent.
    """
    mask, left_out = full_mask(statistics.model), []
    for name, rule in RULES.items():
        if name not in rules:
            continue
        smaller = rule.apply(statistics, mask, min_db - 10 * math.log10(rule.error_budget))
        on_rule()
        count = pruned_count(name, mask, smaller)
        if count:
            saved = stored_bytes(statistics.model, mask) - stored_bytes(statistics.model, smaller)
            of = out_of(name, mask)
            left_out.append(PrunedPart(name, rule.what, count, of, saved, statistics.worst_db(smaller)))
            mask = smaller
    return mask, left_out


def pruned_model(statistics: PruningStatistics, mask: PruningMask, left_out: list[PrunedPart]) -> PrunedModel:
    """The model that is left, with the list that its scene file keeps of what isn't."""
    plain: list[dict[str, Any]] = [entry._asdict() for entry in left_out]
    return pruned(statistics.model, mask, statistics.poses(mask.network).static, plain)


def out_of(rule: str, mask: PruningMask) -> int:
    """How many there are of what a rule leaves out."""
    return {
        "modulation": int(mask.network.modulated),
        "heads": len(mask.network.heads),
        "layers": len(mask.network.layers),
        "invisible": int(mask.kept.sum()),
        "static": int(mask.moves.sum()),
        "sh": mask.sh_degree,
    }[rule]


def pruned_count(rule: str, mask: PruningMask, smaller: PruningMask) -> int:
    """How many of them a smaller mask lacks."""
    return out_of(rule, mask) - out_of(rule, smaller)


def stored_bytes(model: DynamicGaussians, mask: PruningMask) -> int:
    """About what a mask takes in a file of the plan `network`: Gaussians and layers."""
    gaussian = POSE_BYTES + OPACITY_BYTES + COLOR_BYTES * sh_coefficients(mask.sh_degree)
    layers = [model.deformation.layers[k] for k in mask.network.layers] if mask.moves.any() else []
    attributes = sum(kind.bytes_per_gaussian for kind in {export_of(layer) for layer in layers})
    moving = MOVING_BYTES + MODULATION_BYTES * mask.network.modulated + attributes
    weights = 4 * sum(parameter.numel() for layer in layers for parameter in layer.parameters())
    return gaussian * int(mask.kept.sum()) + moving * int(mask.moves.sum()) + weights

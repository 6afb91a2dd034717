"""Pruning rule by rule, each measured in frames of the result of the rules before it."""

import math
from collections.abc import Callable, Collection
from typing import Any

from msdgs_export.pruning.mask import PruningMask, full_mask, kept_layers
from msdgs_export.pruning.rules import RULES
from msdgs_export.pruning.statistics import PruningStatistics
from msdgs_export.supports import support_export_of
from msdgs_serve.scene.spherical_harmonics import sh_coefficients
from msdgs_train.gaussians.model import DynamicGaussians

POSE_BYTES, OPACITY_BYTES, COLOR_BYTES = 40, 4, 12
MODULATION_BYTES = 12
"""Sizes per Gaussian in a scene file in float32: pose, opacity, an SH coefficient; and if it moves, its modulation."""


def prune(
    statistics: PruningStatistics,
    min_db: float,
    rules: Collection[str] = tuple(RULES),
    on_rule: Callable[[], object] = lambda: None,
) -> tuple[PruningMask, list[dict[str, Any]]]:
    """Apply `rules` while the worst selection frame stays at `min_db` dB or more. Returns the mask and the entries of
    `left_out` in its scene file.

    Each rule may spend its fraction of the squared error that this allows, and the rest of earlier rules' budgets.
    """
    mask, left_out = full_mask(statistics.model), []
    for name in (name for name in RULES if name in rules):
        rule = RULES[name]
        smaller = rule.apply(statistics, mask, min_db - 10 * math.log10(rule.error_budget))
        on_rule()
        count = rule.count(mask) - rule.count(smaller)
        if count:
            saved = stored_bytes(statistics.model, mask) - stored_bytes(statistics.model, smaller)
            numbers = {"count": count, "of": rule.count(mask), "bytes_saved": saved}
            left_out.append(
                {"rule": name, "what": rule.what, **numbers, "worst_frame_db": statistics.worst_db(smaller)}
            )
            mask = smaller
    return mask, left_out


def stored_bytes(model: DynamicGaussians, mask: PruningMask) -> int:
    """Approximate size of a file of the plan `network`: Gaussians and layers."""
    gaussian = POSE_BYTES + OPACITY_BYTES + COLOR_BYTES * sh_coefficients(mask.sh_degree)
    layers = kept_layers(model, mask.network) if mask.moves.any() else []
    attributes = support_export_of(model.support).bytes_per_gaussian(model.support) if layers else 0
    moving = MODULATION_BYTES * mask.network.modulated + attributes
    weights = 4 * sum(parameter.numel() for layer in layers for parameter in layer.parameters())
    return gaussian * int(mask.kept.sum()) + moving * int(mask.moves.sum()) + weights

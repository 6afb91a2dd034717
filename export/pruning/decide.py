"""Trimming: rule by rule, each measured in frames of what all rules before it have left."""

import math
from collections.abc import Callable, Collection
from typing import Any, NamedTuple

from export.pruning.mask import Cut, TrimmedModel, trimmed, whole
from export.pruning.rules import RULES
from export.pruning.statistics import Evidence
from msdgs_serve.scene.spherical_harmonics import sh_coefficients
from msdgs_train.gaussians.model import DynamicGaussians
from msdgs_train.supports.nodes import BasisLayer
from msdgs_train.supports.skinning_kernels import K_NEAREST

POSE_BYTES, OPACITY_BYTES, COLOR_BYTES = 40, 4, 12
MOVING_BYTES, MODULATION_BYTES = 8, 12
BASIS_BYTES = K_NEAREST * (4 + 1)
"""Of a Gaussian in a scene file: pose, opacity, an SH coefficient; and where it moves, its id and its modulation, or
the motions that it follows and their weights."""


class LeftOut(NamedTuple):
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


def trim(
    evidence: Evidence,
    least_db: float,
    rules: Collection[str] = tuple(RULES),
    on_rule: Callable[[], object] = lambda: None,
) -> tuple[Cut, list[LeftOut]]:
    """What `rules` leave of the model while the worst deciding frame stays at `least_db` dB or more.

    Each rule may use its share of the squared error that this allows, and what the rules before it have not used.
    """
    cut, left_out = whole(evidence.model), []
    for name, rule in RULES.items():
        if name not in rules:
            continue
        smaller = rule.apply(evidence, cut, least_db - 10 * math.log10(rule.share))
        on_rule()
        count = left_out_count(name, cut, smaller)
        if count:
            saved = stored_bytes(evidence.model, cut) - stored_bytes(evidence.model, smaller)
            of = out_of(name, cut)
            left_out.append(LeftOut(name, rule.what, count, of, saved, evidence.worst_db(smaller)))
            cut = smaller
    return cut, left_out


def trimmed_model(evidence: Evidence, cut: Cut, left_out: list[LeftOut]) -> TrimmedModel:
    """The model that is left, with the list that its scene file keeps of what isn't."""
    plain: list[dict[str, Any]] = [entry._asdict() for entry in left_out]
    return trimmed(evidence.model, cut, evidence.poses(cut.network).still, plain)


def out_of(rule: str, cut: Cut) -> int:
    """How many there are of what a rule leaves out."""
    return {
        "modulation": int(cut.network.modulated),
        "heads": len(cut.network.heads),
        "layers": len(cut.network.layers),
        "unseen": int(cut.kept.sum()),
        "still": int(cut.moves.sum()),
        "bands": cut.sh_degree,
    }[rule]


def left_out_count(rule: str, cut: Cut, smaller: Cut) -> int:
    """How many of them a smaller cut lacks."""
    return out_of(rule, cut) - out_of(rule, smaller)


def stored_bytes(model: DynamicGaussians, cut: Cut) -> int:
    """About what a cut takes in a file of the plan `network`: Gaussians and layers."""
    gaussian = POSE_BYTES + OPACITY_BYTES + COLOR_BYTES * sh_coefficients(cut.sh_degree)
    layers = [model.deformation.layers[k] for k in cut.network.layers] if cut.moves.any() else []
    follows = any(isinstance(layer, BasisLayer) for layer in layers)
    moving = MOVING_BYTES + MODULATION_BYTES * cut.network.modulated + BASIS_BYTES * follows
    weights = 4 * sum(parameter.numel() for layer in layers for parameter in layer.parameters())
    return gaussian * int(cut.kept.sum()) + moving * int(cut.moves.sum()) + weights

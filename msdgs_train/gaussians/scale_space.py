"""In which space deltas of scales are added: to their logarithms, or to the scales themselves."""

import math
from typing import Literal

from torch import Tensor

ScaleSpace = Literal["log", "linear"]

LOG_SCALE_LIMIT = 20.0
"""Scales stay within e^-20 and e^20: where a layer flings a Gaussian away its scale may vanish or overflow, and 0 · inf
is NaN."""

MIN_SCALE = math.exp(-LOG_SCALE_LIMIT)
"""Where deltas are added to scales themselves, a scale may come out negative; it becomes this, far below a pixel."""


def activated_scales(log_scales: Tensor) -> Tensor:
    """Standard deviations of their logarithms, within e^±20."""
    return log_scales.clamp(-LOG_SCALE_LIMIT, LOG_SCALE_LIMIT).exp()


def add_to_scales(space: ScaleSpace, log_scales: Tensor, deltas: Tensor) -> Tensor:
    """Deformed standard deviations, [N, 3]; `deltas` are of logarithms or of scales."""
    if space == "log":
        return activated_scales(log_scales + deltas)
    return (activated_scales(log_scales) + deltas).clamp_min(MIN_SCALE)


def count_clamped(space: ScaleSpace, scales: Tensor) -> int:
    """How many of N Gaussians have a scale that came out at 0 or below and was clamped."""
    return 0 if space == "log" else int((scales <= MIN_SCALE).any(dim=1).sum())

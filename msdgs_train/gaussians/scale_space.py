"""The space in which deltas of scales are added: logarithmic or linear."""

import math
from typing import Literal

from torch import Tensor
from torch.nn.functional import hardtanh

ScaleSpace = Literal["log", "linear"]

LOG_SCALE_LIMIT = 20.0
"""Scales are clamped to [e^-20, e^20]: a layer may produce any delta, and a scale that underflows or overflows gives
NaN."""

MIN_SCALE = math.exp(-LOG_SCALE_LIMIT)
"""Lower bound of scales in linear space; far below a pixel."""


def activated_scales(log_scales: Tensor) -> Tensor:
    """Standard deviations from their logarithms, clamped to e^±20."""
    clamped = hardtanh(log_scales, -LOG_SCALE_LIMIT, LOG_SCALE_LIMIT)  # `clamp`, but a gradient in a tenth of the time
    return clamped.exp()


def add_to_scales(space: ScaleSpace, log_scales: Tensor, deltas: Tensor) -> Tensor:
    """Deformed standard deviations, [N, 3]; `deltas` are of logarithms or of scales.

    Scales that deltas make negative count by their absolute value: covariances depend on their squares only, in the
    rasterizer of 3D Gaussian Splatting too. With a bound at 0, scales below it would have no gradient and stay there.
    """
    if space == "log":
        return activated_scales(log_scales + deltas)
    return (activated_scales(log_scales) + deltas).abs().clamp_min(MIN_SCALE)

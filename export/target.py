"""What is asked of an export: PSNR of its worst frame, and bytes."""

import math

from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.evaluation.metrics import MAX_PSNR

MIN_PSNR = 50.0
"""dB. Errors above it are invisible: the default of an export."""

LOWEST_MIN_PSNR = 10.0
"""Smallest `min_psnr`, dB. Frames below it don't resemble the scene."""

ADDED_DB = 0.05
"""What an export may add to the error against held-out images, dB, if no `min_psnr` is given."""

PLAN_PART = 0.75
"""Of the squared error that a file may have, the part that plan and pruning may use."""


class TargetNotReached(InvalidInput):
    """No export of this model reaches the PSNR, or is as small, as was asked for."""

    @classmethod
    def psnr(cls, reached: float, where: str, asked: float) -> "TargetNotReached":
        """Where the worst frame reached another PSNR, dB."""
        return cls("min_psnr", f"at most {math.floor(10 * reached) / 10:.1f}, which {where} on its worst frame", asked)


def squared(psnr: float) -> float:
    """Squared error of a frame of this PSNR, dB."""
    return 10 ** (-psnr / 10)


def check_min_psnr(min_psnr: float) -> None:
    """Raise `InvalidInput` for a minimum PSNR, dB, that no file reaches or whose frames don't resemble the scene."""
    if not (math.isfinite(min_psnr) and LOWEST_MIN_PSNR <= min_psnr <= MAX_PSNR):
        allowed = f"a PSNR in dB from {LOWEST_MIN_PSNR:g} to {MAX_PSNR:g}; at 50 no difference is visible"
        raise InvalidInput("min_psnr", allowed, min_psnr)

"""What is asked of an export, PSNR of its worst frame and bytes, and which of several files keeps it best."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.evaluation.metrics import MAX_PSNR

MIN_PSNR = 50.0
"""dB. Errors above it are invisible: the default of an export."""

LOWEST_MIN_PSNR = 10.0
"""Smallest `min_psnr`, dB. Frames below it don't resemble the scene."""

ADDED_DB = 0.05
"""What an export may add to the error against held-out images, dB, if no `min_psnr` is given."""

PLAN_PART = 0.75
"""Of the squared error that a file may have, the part that plan and pruning may use if arrays are packed after them."""


class FrameError(Protocol):
    """The error of a file's frames."""

    @property
    def psnr_worst(self) -> float: ...


class MeasuredFile(Protocol):
    """A file whose frames were compared with exact ones."""

    @property
    def error(self) -> FrameError: ...


Measured = TypeVar("Measured", bound=MeasuredFile)


class TargetNotReached(InvalidInput):
    """No export of this model reaches the PSNR, or is as small, as was asked for."""

    @classmethod
    def psnr(cls, reached: float, where: str, asked: float) -> "TargetNotReached":
        """Where the worst frame reached another PSNR, dB."""
        return cls("min_psnr", f"at most {math.floor(10 * reached) / 10:.1f}, which {where} on its worst frame", asked)


@dataclass(frozen=True)
class Target:
    """What the written file must keep."""

    min_psnr: float = MIN_PSNR  # dB, of the worst frame
    max_bytes: int | None = None
    bytes_only: bool = False
    """Whether `max_bytes` alone is required: `min_psnr` is then only the PSNR around which pruning is tried."""
    packs: bool = True  # whether arrays may be stored in fewer bits

    @property
    def plan_part(self) -> float:
        """Of the squared error allowed, the part that plan and pruning may use."""
        return PLAN_PART if self.packs and self.max_bytes is None else 1.0

    @property
    def plan_psnr(self) -> float:
        """PSNR of a plan, dB, that leaves something for storage."""
        return self.min_psnr - 10 * math.log10(self.plan_part)

    def fits(self, size: int) -> bool:
        """Whether a file may have so many bytes."""
        return self.max_bytes is None or size <= self.max_bytes

    def allows(self, error: FrameError) -> bool:
        """Whether a file may have this error."""
        return self.bytes_only or error.psnr_worst >= self.min_psnr

    def require(self, error: FrameError, where: str) -> None:
        """Raise `TargetNotReached` for an error that isn't allowed; `where` says what has it."""
        if not self.allows(error):
            raise TargetNotReached.psnr(error.psnr_worst, where, self.min_psnr)

    def best(
        self, files: Sequence[Measured], where: str, preferred: Callable[[Sequence[Measured]], Measured]
    ) -> Measured:
        """The `preferred` one of the files whose error is allowed, or the most exact one if bytes alone are limited.

        Raises `TargetNotReached` if there is none; `where` says what reaches the highest PSNR.
        """
        finest = max(files, key=lambda file: file.error.psnr_worst)
        self.require(finest.error, where)
        return finest if self.bytes_only else preferred([file for file in files if self.allows(file.error)])


def default_min_psnr(exact_images_psnr: float | None) -> float:
    """The smallest PSNR, dB, that adds no more than `ADDED_DB` to the error of exact frames against held-out images,
    rounded up to a tenth; `MIN_PSNR` without images. Squared errors add up."""
    if exact_images_psnr is None:
        return MIN_PSNR
    added = 10 * math.log10(10 ** (ADDED_DB / 10) - 1)
    return min(math.ceil(10 * (exact_images_psnr - added)) / 10, MAX_PSNR)


def squared(psnr: float) -> float:
    """Squared error of a frame of this PSNR, dB."""
    return 10 ** (-psnr / 10)


def check_min_psnr(min_psnr: float) -> None:
    """Raise `InvalidInput` for a minimum PSNR, dB, that no file reaches or whose frames don't resemble the scene."""
    if not (math.isfinite(min_psnr) and LOWEST_MIN_PSNR <= min_psnr <= MAX_PSNR):
        allowed = f"a PSNR in dB from {LOWEST_MIN_PSNR:g} to {MAX_PSNR:g}; at 50 no difference is visible"
        raise InvalidInput("min_psnr", allowed, min_psnr)

"""Quick estimates of candidates, and which candidates are then measured in full."""

import heapq
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from msdgs_export.jobs.candidate import Candidate
from msdgs_export.jobs.points import TIME_MARGIN
from msdgs_export.target import Target

MIN_USEFUL_DB = 20.0
"""Candidates below it are dropped."""

ESTIMATE_REPEATS = 3
"""A quick estimate takes the minimum of 3 timings."""

DB_MARGIN = 0.5
"""A difference of dB that doesn't count."""

MAX_POINTS = 24


@dataclass(frozen=True, eq=False)
class QuickEstimate:
    """A quick estimate of a candidate: the error of some of its frames, and the processor time of one.

    Processor time is summed over threads; unlike elapsed time it hardly depends on other programs.
    """

    candidate: Candidate
    cpu: float  # milliseconds per frame, the minimum of a few
    cpu_deformation: float  # milliseconds of these
    psnr_worst: float  # dB, of the worst of these frames
    size: int  # bytes: of the smallest file if they are limited, else in float32

    def dominates(self, other: "QuickEstimate", time_margin: float, db_margin: float) -> bool:
        """Whether it is faster and has a smaller error than another, by more than the margins, and isn't larger."""
        faster = self.cpu * time_margin < other.cpu
        return faster and self.psnr_worst > other.psnr_worst + db_margin and self.size <= other.size

    def to_plain(self) -> dict[str, Any]:
        """Plain values for JSON."""
        quick = {"cpu_milliseconds": self.cpu, "psnr_worst": self.psnr_worst}
        return self.candidate.to_plain() | {"quick_estimate": quick}


def undominated(
    estimates: Sequence[QuickEstimate], time_margin: float = TIME_MARGIN, db_margin: float = DB_MARGIN
) -> list[QuickEstimate]:
    """Those that may be useful, and that no other dominates."""

    def dominated(estimate: QuickEstimate) -> bool:
        return any(other.dominates(estimate, time_margin, db_margin) for other in estimates)

    return [e for e in estimates if e.psnr_worst >= MIN_USEFUL_DB and not dominated(e)]


def to_measure(estimates: Sequence[QuickEstimate], target: Target) -> list[QuickEstimate]:
    """The candidates that aren't dominated, as many as are measured in full: the fastest that may be chosen, then the
    fastest of the others; or if speed doesn't count, those with the smallest error."""
    ahead = undominated(estimates)
    if target.max_bytes is not None:
        ahead = [e for e in ahead if target.fits(e.size)] or [min(estimates, key=lambda e: e.size)]
    if target.bytes_only:
        return heapq.nlargest(MAX_POINTS, ahead, key=lambda e: e.psnr_worst)
    # the worst of all frames is no better than the worst of some
    return heapq.nsmallest(MAX_POINTS, ahead, key=lambda e: (not target.allows(e), e.cpu))

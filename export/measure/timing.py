"""Milliseconds per frame of many candidates, interleaved so that load on the machine affects all alike."""

import gc
import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from export.jobs.job import Candidate
from export.measure.views import View
from msdgs_serve.rasterizer import rasterize

REPEATS = 15
SECONDS_PER_CANDIDATE = 6.0
"""If frames take longer, there are fewer repeats, but at least `MIN_REPEATS`."""

MIN_REPEATS = 2


class Milliseconds(NamedTuple):
    """Minimum and median over interleaved repeats, averaged over a few views."""

    min: float
    median: float


class FrameTime(NamedTuple):
    """Time of a frame on this machine, with the service's thread pool."""

    deformation: Milliseconds
    rasterization: Milliseconds
    total: Milliseconds

    def to_plain(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {name: part._asdict() for name, part in self._asdict().items()}


TimingRun = tuple[float, float, float]


def time_frames(
    candidates: Sequence[Candidate],
    views: Sequence[View],
    background: Sequence[float],
    *,
    repeats: int = REPEATS,
    on_repeat: Callable[[], object] = lambda: None,
) -> list[FrameTime]:
    """Time a frame of each candidate at each of the views, `repeats` times over; the first frames don't count."""
    firsts = [time_frame(candidate, views[0], background) for candidate in candidates]
    rounds = [
        max(MIN_REPEATS, min(repeats, int(1e3 * SECONDS_PER_CANDIDATE / (first[2] * len(views))))) for first in firsts
    ]
    runs: list[list[list[TimingRun]]] = [[[] for _ in views] for _ in candidates]
    collecting = gc.isenabled()
    gc.disable()
    try:
        for turn in range(repeats):
            for place, candidate in enumerate(candidates):
                for v, view in enumerate(views if turn < rounds[place] else ()):
                    runs[place][v].append(time_frame(candidate, view, background))
            on_repeat()
    finally:
        if collecting:
            gc.enable()
    return [_frame_time(of_views) for of_views in runs]


def time_frame(
    candidate: Candidate,
    view: View,
    background: Sequence[float],
    clock: Callable[[], float] = time.perf_counter,
) -> TimingRun:
    """Milliseconds of deformation, of rasterization, and of both, for one frame."""
    start = clock()
    gaussians = candidate.session.gaussians(view.t)
    posed = clock()
    rasterize(gaussians, view.camera, background=background, options=candidate.options)
    drawn = clock()
    return 1e3 * (posed - start), 1e3 * (drawn - posed), 1e3 * (drawn - start)


def _frame_time(runs: list[list[TimingRun]]) -> FrameTime:
    """`runs` of each view."""
    parts = []
    for part in range(3):
        of_views = [[run[part] for run in view] for view in runs]
        parts.append(
            Milliseconds(
                statistics.fmean(min(view) for view in of_views),
                statistics.fmean(statistics.median(view) for view in of_views),
            )
        )
    return FrameTime(*parts)

"""Milliseconds a frame of many candidates, measured in turns so that a busy moment of the machine hits all alike."""

import gc
import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from export.jobs.job import Candidate
from export.measure.views import View
from msdgs_serve.rasterizer import rasterize

REPEATS = 15
SECONDS_A_CANDIDATE = 6.0
"""Where frames take longer, there are fewer repeats, though never under `FEWEST_REPEATS`."""

FEWEST_REPEATS = 2


class Milliseconds(NamedTuple):
    """A time over interleaved repeats, the mean over a few views of what each took."""

    min: float
    median: float


class FrameTime(NamedTuple):
    """How long a frame takes, on this machine and on the service's own pool of threads."""

    deformation: Milliseconds
    rasterization: Milliseconds
    total: Milliseconds

    def to_plain(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {name: part._asdict() for name, part in self._asdict().items()}


Lap = tuple[float, float, float]


def time_frames(
    candidates: Sequence[Candidate],
    views: Sequence[View],
    background: Sequence[float],
    *,
    repeats: int = REPEATS,
    on_repeat: Callable[[], object] = lambda: None,
) -> list[FrameTime]:
    """Time a frame of each candidate at each of the views, `repeats` times over; the first frames don't count."""
    firsts = [_lap(candidate, views[0], background) for candidate in candidates]
    rounds = [
        max(FEWEST_REPEATS, min(repeats, int(1e3 * SECONDS_A_CANDIDATE / (first[2] * len(views))))) for first in firsts
    ]
    laps: list[list[list[Lap]]] = [[[] for _ in views] for _ in candidates]
    collecting = gc.isenabled()
    gc.disable()
    try:
        for turn in range(repeats):
            for place, candidate in enumerate(candidates):
                for v, view in enumerate(views if turn < rounds[place] else ()):
                    laps[place][v].append(_lap(candidate, view, background))
            on_repeat()
    finally:
        if collecting:
            gc.enable()
    return [_frame_time(of_views) for of_views in laps]


def _lap(candidate: Candidate, view: View, background: Sequence[float]) -> Lap:
    start = time.perf_counter()
    gaussians = candidate.session.gaussians(view.t)
    posed = time.perf_counter()
    rasterize(gaussians, view.camera, background=background, options=candidate.options)
    drawn = time.perf_counter()
    return 1e3 * (posed - start), 1e3 * (drawn - posed), 1e3 * (drawn - start)


def _frame_time(laps: list[list[Lap]]) -> FrameTime:
    """`laps` of each view."""
    parts = []
    for part in range(3):
        of_views = [[lap[part] for lap in view] for view in laps]
        parts.append(
            Milliseconds(
                statistics.fmean(min(view) for view in of_views),
                statistics.fmean(statistics.median(view) for view in of_views),
            )
        )
    return FrameTime(*parts)

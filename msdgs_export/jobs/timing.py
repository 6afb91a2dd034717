"""Milliseconds per frame of many candidates, interleaved so that load on the machine affects all alike."""

import gc
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from msdgs_export.jobs.candidate import Candidate
from msdgs_export.measure.views import View
from msdgs_export.progress import Track
from msdgs_serve.rasterizer import as_trained, rasterize

REPEATS = 15
SECONDS_PER_CANDIDATE = 6.0
"""With slower frames there are fewer repeats, but at least `MIN_REPEATS`."""

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
    candidates: Sequence[Candidate], views: Sequence[View], background: Sequence[float], track: Track
) -> list[FrameTime]:
    """Time a frame of each candidate at each of the views, up to `REPEATS` times; the first frames don't count."""
    firsts = [time_frame(candidate, views[0], background) for candidate in candidates]
    possible = [int(1e3 * SECONDS_PER_CANDIDATE / (first[2] * len(views))) for first in firsts]
    counts = [max(MIN_REPEATS, min(REPEATS, count)) for count in possible]
    turns = [(i, view) for n in range(REPEATS) for i, count in enumerate(counts) if n < count for view in views]
    runs: list[list[TimingRun]] = [[] for _ in candidates]
    on_frame = track("timing", len(turns))
    collecting = gc.isenabled()
    gc.disable()
    try:
        for i, view in turns:
            runs[i].append(time_frame(candidates[i], view, background))
            on_frame()
    finally:
        if collecting:
            gc.enable()
    return [_frame_time(np.reshape(found, (-1, len(views), 3))) for found in runs]


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
    rasterize(gaussians, view.camera, background=background, options=as_trained(candidate.session.scene.metadata))
    drawn = clock()
    return 1e3 * (posed - start), 1e3 * (drawn - posed), 1e3 * (drawn - start)


def _frame_time(runs: np.ndarray) -> FrameTime:
    """The summary of [repeats, views, 3] times of deformation, rasterization and both."""
    minima, medians = (each.mean(axis=0).tolist() for each in (runs.min(axis=0), np.median(runs, axis=0)))
    return FrameTime(*(Milliseconds(*pair) for pair in zip(minima, medians, strict=True)))

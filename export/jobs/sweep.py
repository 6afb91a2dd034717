"""The sweep: plans × pruning × SH degree. Dominated ones are dropped after a quick estimate, the
rest is measured in full."""

import heapq
import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from operator import le
from typing import Any, NamedTuple

from export.jobs.frame_memory import frame_memory
from export.jobs.job import ESTIMATE_STRIDE, Candidate, ExportJob
from export.jobs.store import min_bytes, nothing_left, usable, within_bytes
from export.jobs.timing import FrameTime, time_frame, time_frames
from export.measure.rendered_error import RenderedError
from export.plans.base import BASELINE
from export.plans.registry import PLANS, parse, plan_of
from export.target import PLAN_PART, TargetNotReached
from msdgs_serve.scene.errors import MsdgsError
from msdgs_serve.scene.metadata import SceneCamera

MAX_RELATIVE_COST = 4.0
"""A plan that runs layers isn't tried if its layers take this many times the whole frame of a plan within the error."""

PRUNING_STEPS = (10.0, 5.0, 2.0, -5.0, -10.0)
"""dB above or below `min_psnr` at which pruning is tried."""

SMALLER_STEPS = (-15.0, -20.0, -25.0)
"""The same, if bytes are limited too."""

MIN_PRUNING_DB, MIN_USEFUL_DB = 25.0, 20.0
"""Pruning isn't tried below the first; candidates below the second are dropped."""

HEADROOM = (2.0, -3.0)
"""dB. Each level of pruning is tried with the fastest plan whose error, mildly pruned, is better than the level by the
first value, and by the second. Of plans that are about as fast, the one with the smallest file counts."""

ESTIMATE_REPEATS = 3
"""A quick estimate takes the minimum of 3 timings."""

TIME_MARGIN, DB_MARGIN = 1.15, 0.5
"""A factor of time and a difference of dB that don't count: timings of one file differ by as much."""

MAX_POINTS = 24
LOWER_DEGREES = 3
"""The number of candidates of which lower SH degrees are tried."""

TIMED_VIEWS = 3


@dataclass(frozen=True, eq=False)
class QuickEstimate:
    """A quick estimate of a candidate: the error of some of its frames, and the processor time of one.

    Processor time is summed over threads; unlike elapsed time it hardly depends on other programs.
    """

    candidate: Candidate
    cpu: float  # milliseconds per frame, the minimum of a few
    cpu_deformation: float  # milliseconds of these
    worst_db: float  # PSNR of the worst of these frames
    size: int  # bytes: of the smallest file if they are limited, else in float32

    def dominates(self, other: "QuickEstimate", time_margin: float, db_margin: float) -> bool:
        """Whether it is faster and has a smaller error than another, by more than the margins, and isn't larger."""
        faster = self.cpu * time_margin < other.cpu
        return faster and self.worst_db > other.worst_db + db_margin and self.size <= other.size

    def to_plain(self) -> dict[str, Any]:
        """Plain values for JSON."""
        quick = {"cpu_milliseconds": self.cpu, "psnr_worst": self.worst_db}
        return named(self.candidate) | {"quick_estimate": quick}


@dataclass(frozen=True, eq=False)
class Point:
    """A candidate, measured in full."""

    candidate: Candidate
    time: FrameTime
    error: RenderedError
    memory: int | None  # bytes at the peak of a frame
    images_psnr: float | None

    @property
    def milliseconds(self) -> float:
        """Minimum over the repeats of a whole frame."""
        return self.time.total.min

    @property
    def costs(self) -> tuple[float, float, int]:
        """What is better if smaller: milliseconds, negative PSNR of the worst frame, bytes."""
        return self.milliseconds, -self.error.psnr_worst, self.candidate.size

    def to_plain(self) -> dict[str, Any]:
        """Plain values for JSON."""
        scene = self.candidate.session.scene
        return named(self.candidate) | {
            "moving": scene.moving_count,
            "static": scene.static_count,
            "layers": len(scene.metadata.layers),
            "bytes": self.candidate.size,
            "packed": self.candidate.float32 is not None,
            "memory_bytes": self.memory,
            "milliseconds": self.time.to_plain(),
            "error": self.error.to_plain(),
            "images_psnr": self.images_psnr,
            "left_out": list(scene.metadata.left_out),
        }


def named(candidate: Candidate) -> dict[str, Any]:
    """The keys that identify a point."""
    return {"plan": candidate.plan, "pruning_db": candidate.pruning_db, "sh_degree": candidate.sh_degree}


def front(points: Sequence[Point]) -> list[int]:
    """Indices of the points on the Pareto front of time, error and bytes, the fastest first."""
    fast = sorted((point.costs, i) for i, point in enumerate(points))
    return [i for n, (costs, i) in enumerate(fast) if not any(all(map(le, other, costs)) for other, _ in fast[:n])]


def choose(points: Sequence[Point], min_psnr: float | None) -> int | None:
    """The index of the smallest of the points about as fast as the fastest, of those whose worst frame has at least
    `min_psnr` dB; or if that is None, of the one with the smallest error. It lies on the front."""
    if min_psnr is None:
        return max(front(points), key=lambda i: points[i].error.psnr_worst, default=None)
    enough = [i for i in front(points) if points[i].error.psnr_worst >= min_psnr]
    fast = [i for i in enough if points[i].milliseconds <= TIME_MARGIN * points[enough[0]].milliseconds]
    return min(fast, key=lambda i: points[i].candidate.size, default=None)


def pruning_levels(job: ExportJob) -> list[float]:
    """The PSNRs, dB, to which pruning is tried, the mildest first."""
    levels = [job.min_psnr + step for step in PRUNING_STEPS + (SMALLER_STEPS if job.max_bytes is not None else ())]
    return [level for level in levels if level >= MIN_PRUNING_DB]


class SweepResult(NamedTuple):
    """The result of a sweep."""

    points: list[Point]
    estimates: list[QuickEstimate]  # of candidates that were dropped
    chosen: int  # index of a point
    refused: list[tuple[str, str]]  # plans and why they were refused
    front: list[int]  # indices of points


class Sweep:
    """One sweep over the candidates of a job."""

    def __init__(self, job: ExportJob) -> None:
        """If the job limits bytes, points are packed to fit."""
        self.job, self.min_psnr, self.max_bytes = job, job.required_psnr, job.max_bytes
        self.estimates: list[QuickEstimate] = []
        self.baseline: QuickEstimate | None = None  # the whole network; None if it can't be run in float32
        self.refused: list[tuple[str, str]] = []
        self._measured_errors: dict[Candidate, RenderedError] = {}  # of all frames
        views = job.exact.views
        self._timed = [views[len(views) * i // TIMED_VIEWS] for i in range(TIMED_VIEWS)]

    def run(self) -> SweepResult:
        """Estimate all candidates, then measure those that may be on the front.

        Raises `TargetNotReached` if even the whole network in float32 is further from float64 than allowed, or if no
        file keeps the limits.
        """
        self._estimate_all("the whole network", [(BASELINE, None)])
        self.baseline = next(iter(self.estimates), None)
        self._reachable(self.baseline)
        levels = [level for level in pruning_levels(self.job) if self.job.pruned(level).left_out]
        mildest = next(iter(levels), None)  # plans are then fitted to moving Gaussians only
        self._estimate_all("fitted plans", [(text, mildest) for text in self._texts(fitted=True)])
        self._estimate_all("network", [(BASELINE, level) for level in levels])
        self._estimate_all("other plans", [(text, mildest) for text in self._texts(fitted=False)])
        unvaried = [estimate for estimate in self.estimates if estimate.candidate.pruning_db == mildest]
        pairs = [pair for level in levels if level != mildest for pair in self._pairs(unvaried, level)]
        self._estimate_all("plans with pruning", pairs)
        self._estimate_all("SH degree", self._degrees())
        return self._measured()

    def _texts(self, fitted: bool) -> list[str]:
        """The names that the plans propose for this model."""
        plans = [plan for plan in PLANS.values() if plan.fitted == fitted]
        return [text for plan in plans for text in plan.candidates(len(self.job.model.deformation))]

    def _estimate(self, plan: str, pruning_db: float | None, sh_degree: int | None = None) -> None:
        moving = self.job.pruned(pruning_db).moving
        if plan != BASELINE and not (len(moving.gaussians) and len(moving.deformation)):
            return  # nothing moves: all plans give the same file
        if self.estimates and (why := self._too_expensive(plan, pruning_db)):
            self.refused.append((plan, why))
            return
        try:
            candidate = self.job.candidate(plan, pruning_db, sh_degree)
            if not any(estimate.candidate.digest == candidate.digest for estimate in self.estimates):
                self.estimates.append(self._estimated(candidate))  # else pruning to another PSNR removed the same
        except MsdgsError as error:  # also if its motion overflows in float32
            self.refused.append((plan, str(error)))

    def _estimated(self, candidate: Candidate) -> QuickEstimate:
        view, background, runs = self._timed[0], self.job.info.background, []
        for _ in range(1 + ESTIMATE_REPEATS):
            runs.append(time_frame(candidate, view, background, time.process_time))
            self.job.on_work()
        # each of the whole network's frames may take seconds, and `_reachable` needs all of them
        whole = candidate.plan == BASELINE and candidate.pruning_db is None and self.min_psnr is not None
        error = self._error(candidate) if whole else self.job.error(candidate, every=ESTIMATE_STRIDE)
        deformation, _, total = (min(run[part] for run in runs[1:]) for part in range(3))
        candidate.close()
        size = candidate.size if self.max_bytes is None else min_bytes(self.job, candidate)
        return QuickEstimate(candidate, total, deformation, error.psnr_worst, size)

    def _estimate_all(self, name: str, candidates: Sequence[tuple]) -> None:
        """Estimate candidates, given as the arguments of `_estimate`."""
        on_estimate = self.job.progress(f"candidates: {name}", len(candidates))
        for candidate in candidates:
            self._estimate(*candidate)
            on_estimate()

    def _too_expensive(self, plan: str, pruning_db: float | None) -> str | None:
        """Why a plan that runs layers isn't tried; None if it is."""
        if self.max_bytes is not None:
            return None  # its file may be smaller
        enough = [estimate for estimate in self.estimates if estimate.worst_db >= self.job.min_psnr]
        fitted = [estimate for estimate in enough if plan_of(estimate.candidate.plan).fitted]
        fastest = min(fitted, key=lambda estimate: estimate.cpu, default=None)
        kind = plan_of(plan)
        if fastest is None or self.baseline is None or kind.fitted:
            return None
        model = self.job.pruned(pruning_db).moving
        layers = parse(plan).count or len(model.deformation)
        work = len(model.gaussians) * layers / max(len(self.job.model.gaussians) * len(self.job.model.deformation), 1)
        expected = self.baseline.cpu_deformation * work
        if expected < MAX_RELATIVE_COST * fastest.cpu:
            return None
        taken = f"{fastest.candidate.plan} takes {fastest.cpu:.0f} ms for the whole frame"
        return f"not tried: its layers would take about {expected:.0f} ms of processor time; {taken}"

    def _reachable(self, estimate: QuickEstimate | None) -> None:
        if estimate is None or self.min_psnr is None:  # its layers can't be run in float32; fitted plans may work
            return
        best = self._error(estimate.candidate)
        if best.psnr_worst < self.min_psnr:
            raise TargetNotReached.psnr(best.psnr_worst, "the whole network in float32 reaches", self.min_psnr)

    def _pairs(self, unvaried: list[QuickEstimate], level: float) -> set[tuple[str, float]]:
        """The plans to try with pruning to `level` dB."""
        pairs = set()
        for headroom in HEADROOM:
            enough = [estimate for estimate in unvaried if estimate.worst_db >= level + headroom]
            least = min((estimate.cpu_deformation for estimate in enough), default=0.0)
            fast = [estimate for estimate in enough if estimate.cpu_deformation <= TIME_MARGIN * least]
            if fast:
                pairs.add((min(fast, key=lambda estimate: estimate.size).candidate.plan, level))
            if enough and self.max_bytes is not None:
                pairs.add((min(enough, key=lambda estimate: estimate.size).candidate.plan, level))
        return pairs

    def _degrees(self) -> list[tuple[str, float | None, int]]:
        """Lower SH degrees of the fastest candidates that aren't dominated so far, or of those nearest to the limit."""
        limit = self.max_bytes
        ahead = sorted(self._undominated(1.0, 0.0), key=lambda e: e.cpu if limit is None else abs(e.size - limit))
        chosen = [estimate.candidate for estimate in ahead[:LOWER_DEGREES]]
        chosen.sort(key=lambda c: c.pruning_db or 0.0)  # so that the trajectories of a pruned model are sampled once
        return [(c.plan, c.pruning_db, degree) for c in chosen for degree in range(c.sh_degree)]

    def _undominated(self, time_margin: float = TIME_MARGIN, db_margin: float = DB_MARGIN) -> list[QuickEstimate]:
        def dominated(estimate: QuickEstimate) -> bool:
            return any(other.dominates(estimate, time_margin, db_margin) for other in self.estimates)

        return [e for e in self.estimates if e.worst_db >= MIN_USEFUL_DB and not dominated(e)]

    def ahead(self) -> list[QuickEstimate]:
        """The candidates that aren't dominated, as many as are measured in full: the fastest that may be chosen, then
        the fastest of the others; or if speed doesn't count, those with the smallest error."""
        ahead, least = self._undominated(), self.min_psnr
        if self.max_bytes is not None:
            ahead = [e for e in ahead if e.size <= self.max_bytes] or [min(self.estimates, key=lambda e: e.size)]
        if least is None:
            return heapq.nlargest(MAX_POINTS, ahead, key=lambda e: e.worst_db)
        # the worst of all frames is no better than the worst of some
        return heapq.nsmallest(MAX_POINTS, ahead, key=lambda e: (e.worst_db < least, e.cpu))

    def _measured(self) -> SweepResult:
        if not self.estimates:
            raise nothing_left(self.refused)
        ahead = self.ahead()
        ahead += [self.baseline] if self.baseline is not None and self.baseline not in ahead else []
        candidates = [estimate.candidate for estimate in ahead]
        if self.max_bytes is None:
            tracked = self._tracked(candidates)
            measured = list(usable(tracked, lambda candidate: (candidate, self._error(candidate)), self.refused))
        else:
            measured = within_bytes(self.job, candidates, self.refused)
        points = self._points(measured)
        left = [estimate for estimate in self.estimates if estimate not in ahead]
        return SweepResult(points, left, self._best(points), self.refused, front(points))

    def _best(self, points: list[Point]) -> int:
        best = choose(points, self.min_psnr)
        if best is None:  # estimates see only some of the frames, in float32
            reached = max(point.error.psnr_worst for point in points)
            where = "a file reaches" if self.max_bytes is None else "a file reaches that fits"
            raise TargetNotReached.psnr(reached, where, self.job.min_psnr)
        if self.max_bytes is not None or not self.job.packs:
            return best
        leaves = choose(points, self.job.min_psnr - 10 * math.log10(PLAN_PART))  # something for storage
        fastest = min(p.milliseconds for p in points if p.error.psnr_worst >= self.job.min_psnr)
        return best if leaves is None or points[leaves].milliseconds > TIME_MARGIN * fastest else leaves

    def _points(self, measured: list[tuple[Candidate, RenderedError]]) -> list[Point]:
        """Points of candidates and their errors, but for those that can't be drawn at a held-out image's time."""
        errors, job = dict(measured), self.job
        images = dict(usable(errors, lambda candidate: (candidate, _images_psnr(job, candidate)), self.refused))
        candidates = list(images)
        times = time_frames(candidates, self._timed, self.job.info.background, self.job.progress)
        memory = _memory(self.job, candidates)
        parts = zip(candidates, times, memory, strict=True)
        return [Point(c, time, errors[c], bytes_, images[c]) for c, time, bytes_ in parts]

    def _tracked(self, candidates: list[Candidate]) -> Iterator[Candidate]:
        on_error = self.job.progress("all frames of the points", len(candidates))
        for candidate in candidates:
            yield candidate
            on_error()

    def _error(self, candidate: Candidate) -> RenderedError:
        """The error of all frames, measured once."""
        if candidate not in self._measured_errors:
            self._measured_errors[candidate] = self.job.error(candidate)
        return self._measured_errors[candidate]


def as_stored(job: ExportJob, point: Point, candidate: Candidate, error: RenderedError) -> Point:
    """A point with the file in which its candidate is stored: measured in full, but for times, which are the same."""
    if candidate is point.candidate:
        return point
    (memory,), images_psnr = _memory(job, [candidate]), _images_psnr(job, candidate)
    return replace(point, candidate=candidate, error=error, memory=memory, images_psnr=images_psnr)


def _memory(job: ExportJob, candidates: Sequence[Candidate]) -> list[int | None]:
    view = job.exact.views[0]
    camera = SceneCamera("timed", view.t, view.camera)
    return frame_memory([candidate.path for candidate in candidates], camera, job.progress)


def _images_psnr(job: ExportJob, candidate: Candidate) -> float | None:
    return job.images.psnr(candidate.session.gaussians, job.model.rasterizer) if job.images else None

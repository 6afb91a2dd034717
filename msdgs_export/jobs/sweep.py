"""The sweep: plans × pruning × SH degree. Dominated ones are dropped after a quick estimate, the rest is measured."""

import time
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from msdgs_export.jobs.builder import CandidateBuilder
from msdgs_export.jobs.candidate import Candidate, Measured, nothing_left, usable
from msdgs_export.jobs.estimates import ESTIMATE_REPEATS, QuickEstimate, to_measure, undominated
from msdgs_export.jobs.fit_bytes import min_bytes, within_bytes
from msdgs_export.jobs.points import TIME_MARGIN, Point, choose, front, points_of
from msdgs_export.jobs.pruned_models import pruning_levels
from msdgs_export.jobs.ruler import ESTIMATE_STRIDE, Ruler
from msdgs_export.jobs.timing import time_frame
from msdgs_export.measure.rendered_error import RenderedError
from msdgs_export.plans.base import BASELINE
from msdgs_export.plans.registry import PLANS, parse, plan_of
from msdgs_export.target import Target
from msdgs_serve.scene.errors import MsdgsError

MAX_RELATIVE_COST = 4.0
"""A plan that runs layers isn't tried if its layers take this many times the whole frame of a plan within the error."""

HEADROOM = (2.0, -3.0)
"""dB. Each level of pruning is tried with the fastest plan whose error, mildly pruned, is better than the level by the
first value, and by the second. Of plans that are about as fast, the one with the smallest file counts."""

LOWER_DEGREES = 3
"""The number of candidates of which lower SH degrees are tried."""

TIMED_VIEWS = 3


class SweepResult(NamedTuple):
    """The result of a sweep."""

    points: list[Point]
    estimates: list[QuickEstimate]  # of candidates that were dropped
    chosen: int  # index of a point
    refused: list[tuple[str, str]]  # plans and why they were refused
    front: list[int]  # indices of the points on the Pareto front


class Sweep:
    """One sweep over the candidates that a builder makes. If the target limits bytes, points are packed to fit."""

    def __init__(self, builder: CandidateBuilder, ruler: Ruler, target: Target) -> None:
        self._builder, self._ruler, self._target = builder, ruler, target
        self._estimates: list[QuickEstimate] = []
        self._baseline: QuickEstimate | None = None  # the whole network; None if it can't be run in float32
        self._refused: list[tuple[str, str]] = []
        self._measured_errors: dict[Candidate, RenderedError] = {}  # of all frames
        views = ruler.views
        self._timed = [views[len(views) * i // TIMED_VIEWS] for i in range(TIMED_VIEWS)]

    def run(self) -> SweepResult:
        """Estimate all candidates, then measure those that may be on the front.

        Raises `TargetNotReached` if even the whole network in float32 is further from float64 than allowed, or if no
        file keeps the limits.
        """
        self._estimate_all("the whole network", [(BASELINE, None)])
        self._baseline = next(iter(self._estimates), None)
        self._reachable(self._baseline)
        levels = [level for level in pruning_levels(self._target) if self._builder.pruning.at(level).left_out]
        mildest = next(iter(levels), None)  # plans are then fitted to moving Gaussians only
        self._estimate_all("fitted plans", [(text, mildest) for text in self._texts(fitted=True)])
        self._estimate_all("network", [(BASELINE, level) for level in levels])
        self._estimate_all("other plans", [(text, mildest) for text in self._texts(fitted=False)])
        unvaried = [estimate for estimate in self._estimates if estimate.candidate.pruning_db == mildest]
        pairs = [pair for level in levels if level != mildest for pair in sorted(self._pairs(unvaried, level))]
        self._estimate_all("plans with pruning", pairs)
        if "sh" in self._builder.pruning.rules:
            self._estimate_all("SH degree", self._degrees())
        return self._measured()

    def _texts(self, fitted: bool) -> list[str]:
        """The names that the plans propose for this model."""
        plans = [plan for plan in PLANS.values() if plan.fitted == fitted]
        return [text for plan in plans for text in plan.candidates(len(self._builder.model.deformation))]

    def _estimate(self, plan: str, pruning_db: float | None, sh_degree: int | None = None) -> None:
        moving = self._builder.pruning.at(pruning_db).moving
        if plan != BASELINE and not (len(moving.gaussians) and len(moving.deformation)):
            return  # nothing moves: all plans give the same file
        if self._estimates and (why := self._too_expensive(plan, pruning_db)):
            self._refused.append((plan, why))
            return
        try:
            candidate = self._builder.candidate(plan, pruning_db, sh_degree)
            if not any(estimate.candidate.digest == candidate.digest for estimate in self._estimates):
                self._estimates.append(self._estimated(candidate))  # else pruning to another PSNR removed the same
        except MsdgsError as error:  # also if its motion overflows in float32
            self._refused.append((plan, str(error)))

    def _estimated(self, candidate: Candidate) -> QuickEstimate:
        view, background, runs = self._timed[0], self._ruler.background, []
        for _ in range(1 + ESTIMATE_REPEATS):
            runs.append(time_frame(candidate, view, background, time.process_time))
            self._ruler.on_work()
        # each of the whole network's frames may take seconds, and `_reachable` needs all of them
        whole = candidate.plan == BASELINE and candidate.pruning_db is None and not self._target.bytes_only
        error = self._error(candidate) if whole else self._ruler.error(candidate, every=ESTIMATE_STRIDE)
        deformation, _, total = (min(run[part] for run in runs[1:]) for part in range(3))
        candidate.close()
        size = candidate.size if self._target.max_bytes is None else min_bytes(candidate, self._target)
        return QuickEstimate(candidate, total, deformation, error.psnr_worst, size)

    def _estimate_all(self, name: str, candidates: Sequence[tuple]) -> None:
        """Estimate candidates, given as the arguments of `_estimate`."""
        on_estimate = self._ruler.track(f"candidates: {name}", len(candidates))
        for candidate in candidates:
            self._estimate(*candidate)
            on_estimate()

    def _too_expensive(self, plan: str, pruning_db: float | None) -> str | None:
        """Why a plan that runs layers isn't tried; None if it is."""
        if self._target.max_bytes is not None:
            return None  # its file may be smaller
        enough = [estimate for estimate in self._estimates if self._target.allows(estimate)]
        fitted = [estimate for estimate in enough if plan_of(estimate.candidate.plan).fitted]
        fastest = min(fitted, key=lambda estimate: estimate.cpu, default=None)
        kind = plan_of(plan)
        if fastest is None or self._baseline is None or kind.fitted:
            return None
        model, whole = self._builder.pruning.at(pruning_db).moving, self._builder.model
        layers = parse(plan).count or len(model.deformation)
        work = len(model.gaussians) * layers / max(len(whole.gaussians) * len(whole.deformation), 1)
        expected = self._baseline.cpu_deformation * work
        if expected < MAX_RELATIVE_COST * fastest.cpu:
            return None
        taken = f"{fastest.candidate.plan} takes {fastest.cpu:.0f} ms for the whole frame"
        return f"not tried: its layers would take about {expected:.0f} ms of processor time; {taken}"

    def _reachable(self, estimate: QuickEstimate | None) -> None:
        if estimate is None or self._target.bytes_only:  # its layers can't be run in float32; fitted plans may work
            return
        self._target.require(self._error(estimate.candidate), "the whole network in float32 reaches")

    def _pairs(self, unvaried: list[QuickEstimate], level: float) -> set[tuple[str, float]]:
        """The plans to try with pruning to `level` dB."""
        pairs = set()
        for headroom in HEADROOM:
            enough = [estimate for estimate in unvaried if estimate.psnr_worst >= level + headroom]
            least = min((estimate.cpu_deformation for estimate in enough), default=0.0)
            fast = [estimate for estimate in enough if estimate.cpu_deformation <= TIME_MARGIN * least]
            if fast:
                pairs.add((min(fast, key=lambda estimate: estimate.size).candidate.plan, level))
            if enough and self._target.max_bytes is not None:
                pairs.add((min(enough, key=lambda estimate: estimate.size).candidate.plan, level))
        return pairs

    def _degrees(self) -> list[tuple[str, float | None, int]]:
        """Lower SH degrees of the fastest candidates that aren't dominated so far, or of those nearest to the limit."""
        limit, ahead = self._target.max_bytes, undominated(self._estimates, 1.0, 0.0)
        ahead.sort(key=lambda e: e.cpu if limit is None else abs(e.size - limit))
        chosen = [estimate.candidate for estimate in ahead[:LOWER_DEGREES]]
        chosen.sort(key=lambda c: c.pruning_db or 0.0)  # so that the trajectories of a pruned model are sampled once
        return [(c.plan, c.pruning_db, degree) for c in chosen for degree in range(c.sh_degree)]

    def _measured(self) -> SweepResult:
        if not self._estimates:
            raise nothing_left(self._refused)
        ahead = to_measure(self._estimates, self._target)
        ahead += [self._baseline] if self._baseline is not None and self._baseline not in ahead else []
        candidates = [estimate.candidate for estimate in ahead]
        if self._target.max_bytes is None:
            tracked = self._tracked(candidates)
            measured = list(usable(tracked, lambda each: Measured(each, self._error(each)), self._refused))
        else:
            measured = within_bytes(candidates, self._ruler, self._target, self._refused)
        points = points_of(measured, self._timed, self._ruler, self._refused)
        left = [estimate for estimate in self._estimates if estimate not in ahead]
        return SweepResult(points, left, choose(points, self._target), self._refused, front(points))

    def _tracked(self, candidates: list[Candidate]) -> Iterator[Candidate]:
        on_error = self._ruler.track("all frames of the points", len(candidates))
        for candidate in candidates:
            yield candidate
            on_error()

    def _error(self, candidate: Candidate) -> RenderedError:
        """The error of all frames, measured once."""
        if candidate not in self._measured_errors:
            self._measured_errors[candidate] = self._ruler.error(candidate)
        return self._measured_errors[candidate]

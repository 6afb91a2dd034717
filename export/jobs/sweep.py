"""The sweep: plans × trimming × SH degree × rasterizer options, dominated ones left after a quick look, the rest
measured in full."""

import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

from export.jobs.job import Candidate, Job, Unreachable
from export.jobs.points import DEFAULT_RASTERIZER, Look, Point, choose
from export.measure.frame_memory import frame_memory
from export.measure.rendered_error import RenderedError
from export.measure.timing import REPEATS, time_frames
from export.measure.views import View
from export.plans.registry import parse
from msdgs_serve.rasterizer import rasterize
from msdgs_serve.scene.errors import InvalidInput, MsdgsError
from msdgs_serve.scene.metadata import SceneCamera

if TYPE_CHECKING:
    from export.measure.images import Images

FITTED = ("lowrank:0.5", "lowrank:0.1", "keyframes:2.0", "keyframes:0.5", "keyframes:0.1", "keyframes:0.03")
"""By the pixels that they may be off by. Besides them `network`, every prefix of it, and `int8` are tried."""

INT8_SPEEDUP = 3.8
DEAR = 4.0
"""A plan that runs layers isn't tried where they would take so many times a whole frame of one that is close enough."""

TRIM_STEPS = (20.0, 10.0, 5.0, 1.0, -5.0, -10.0, -15.0)
"""dB above or below the error allowed, at which trimming is tried."""

WORTH_DB, WORST_DB = 25.0, 20.0
"""Trimming isn't tried under the first, and a candidate under the second is no longer an image of the scene."""

HEADROOM = (2.0, -3.0)
"""With trimming to so many dB goes the fastest plan that alone is better by the first, and the one by the second; of
those that are about as fast, the smallest."""

EVERY, LOOKS = 6, 3
"""A quick look compares every 6th frame and takes the least of 3 times."""

TIME_MARGIN, DB_MARGIN = 1.15, 0.5
MOST_POINTS = 24
LOWER_DEGREES = 3
"""Candidates of which lower SH degrees are tried."""

TIMED_VIEWS = 3

RASTERIZERS = {"alpha ≥ 2/255": {"alpha_min": 2 / 255}, "ends at 1 %": {"transmittance_min": 1e-2}}
"""Tried on the chosen point, to show what they would buy."""


class SweepResult(NamedTuple):
    """All that a sweep has found."""

    points: list[Point]
    looks: list[Look]  # candidates that were left after a quick look
    chosen: int  # index of a point
    refused: list[tuple[str, str]]  # plans that this scene can't have, and why
    exact_images_db: float | None


class Sweep:
    """One sweep over a job's candidates."""

    def __init__(self, job: Job, min_psnr: float, photographs: "Images | None" = None) -> None:
        self.job, self.min_psnr, self.images = job, min_psnr, photographs
        self.looks: list[Look] = []
        self.refused: list[tuple[str, str]] = []
        views = job.exact.views
        self._timed = [views[len(views) * i // TIMED_VIEWS] for i in range(TIMED_VIEWS)]

    def run(self) -> SweepResult:
        """Look at all candidates, then measure those that may be on the front.

        Raises `Unreachable` where even the whole network in float32 is further from float64 than allowed.
        """
        levels = [self.min_psnr + step for step in TRIM_STEPS if self.min_psnr + step >= WORTH_DB]
        self._reachable(self._look("network", None))
        # the most careful trimming that leaves anything out: plans are fitted to what moves, not to still ground
        careful = next((level for level in levels if self.job.trimmed(level).left_out), None)
        self._tell("candidates: fitted plans", [(self._look, (text, careful)) for text in FITTED])
        self._tell("candidates: network", [(self._look, ("network", level)) for level in levels])
        texts = [f"prefix:{k}" for k in range(1, len(self.job.model.deformation))]
        self._tell("candidates: other plans", [(self._look, (text, careful)) for text in (*texts, "int8")])
        alone = [look for look in self.looks if look.candidate.trim_db == careful]
        pairs = [pair for level in levels if level != careful for pair in self._pairs(alone, level)]
        self._tell("candidates: plans with trimming", [(self._look, pair) for pair in pairs])
        self._tell("candidates: SH degree", [(self._look, what) for what in self._degrees()])
        return self._measured()

    def _look(self, plan: str, trim_db: float | None, sh_degree: int | None = None) -> Look | None:
        if plan != "network" and not len(self.job.trimmed(trim_db).moving.gaussians):
            return None  # nothing moves, so all plans are the same
        if self.looks and (why := self._dear(plan, trim_db)):
            self.refused.append((plan, why))
            return None
        try:
            candidate = self.job.candidate(plan, trim_db, sh_degree)
        except MsdgsError as error:
            self.refused.append((plan, str(error)))
            return None
        if any(same(look.candidate, candidate) for look in self.looks):
            return None
        laps = [self._lap(candidate, view) for view in self._timed[:1] * (1 + LOOKS)][1:]
        error = self.job.error(candidate, every=EVERY)
        total, deformation = (min(lap[part] for lap in laps) for part in range(2))
        candidate.close()
        self.looks.append(Look(candidate, DEFAULT_RASTERIZER, total, deformation, error.psnr_worst))
        return self.looks[-1]

    def _dear(self, plan: str, trim_db: float | None) -> str | None:
        """Why a plan that runs layers when a frame is served isn't worth a try, where it isn't."""
        enough = [look for look in self.looks if look.worst_db >= self.min_psnr and parse(look.candidate.plan).fitted]
        fastest = min(enough, key=lambda look: look.cpu, default=None)
        if fastest is None or parse(plan).fitted:
            return None
        whole, model = self.looks[0], self.job.trimmed(trim_db).moving
        layers = len(model.deformation) if plan in ("network", "int8") else (parse(plan).count or 0)
        work = len(model.gaussians) * layers / max(len(self.job.model.gaussians) * len(self.job.model.deformation), 1)
        expected = whole.cpu_deformation * work / (INT8_SPEEDUP if plan == "int8" else 1)
        if expected < DEAR * fastest.cpu:
            return None
        taken = f"{fastest.candidate.plan} takes {fastest.cpu:.0f} ms for the whole frame"
        return f"not tried: its layers would take about {expected:.0f} ms of processor time, where {taken}"

    def _lap(self, candidate: Candidate, view: View) -> tuple[float, float]:
        start = time.process_time()
        gaussians = candidate.session.gaussians(view.t)
        posed = time.process_time()
        rasterize(gaussians, view.camera, background=self.job.info.background, options=candidate.options)
        return 1e3 * (time.process_time() - start), 1e3 * (posed - start)

    def _reachable(self, look: Look | None) -> None:
        if look is None:  # its layers can't be run in float32; other plans may still do
            return
        best = self.job.error(look.candidate)
        if best.psnr_worst < self.min_psnr:
            reachable = math.floor(10 * best.psnr_worst) / 10
            expected = f"at most {reachable:.1f}, which the whole network in float32 reaches on its worst frame"
            raise Unreachable("min_psnr", expected, self.min_psnr)

    def _pairs(self, alone: list[Look], level: float) -> set[tuple[str, float]]:
        """The plans worth trying with trimming to `level` dB."""
        pairs = set()
        for headroom in HEADROOM:
            enough = [look for look in alone if look.worst_db >= level + headroom]
            least = min((look.cpu_deformation for look in enough), default=0.0)
            fast = [look for look in enough if look.cpu_deformation <= TIME_MARGIN * least]
            if fast:
                pairs.add((min(fast, key=lambda look: look.candidate.size).candidate.plan, level))
        return pairs

    def _degrees(self) -> list[tuple[str, float | None, int]]:
        """Lower SH degrees of the fastest on the front of the looks so far."""
        ahead = sorted(self._undominated(0.0), key=lambda look: look.cpu)
        chosen = [look.candidate for look in ahead[:LOWER_DEGREES]]
        chosen.sort(key=lambda c: c.trim_db or 0.0)  # plans share what they sample of one trimmed model
        return [(c.plan, c.trim_db, degree) for c in chosen for degree in range(c.sh_degree)]

    def _undominated(self, db_margin: float = DB_MARGIN) -> list[Look]:
        def beaten(look: Look) -> bool:
            margins = {"time_margin": TIME_MARGIN if db_margin else 1.0, "db_margin": db_margin}
            return any(other.dominates(look, **margins) for other in self.looks)

        return [look for look in self.looks if look.worst_db >= WORST_DB and not beaten(look)]

    def _measured(self) -> SweepResult:
        if not self.looks:
            raise InvalidInput("model", "one that some plan can hold", "; ".join(why for _, why in self.refused))
        baseline = self.looks[0]  # the whole network, what all others are compared with
        ahead = sorted(self._undominated(), key=lambda look: look.cpu)[:MOST_POINTS]
        ahead += [] if baseline in ahead else [baseline]
        points = self._points([look.candidate for look in ahead])
        best = choose(points, self.min_psnr)
        if best is None:  # looks were at some of the frames only
            raise Unreachable("min_psnr", f"at most {max(p.error.psnr_worst for p in points):.1f}", self.min_psnr)
        left = [look for look in self.looks if look not in ahead]
        return SweepResult(points, left, best, self.refused, self._exact_images())

    def _points(self, candidates: list[Candidate]) -> list[Point]:
        """All measured in full, and the one that looks like the choice with other rasterizer options as well."""
        errors = self._errors(candidates)
        within = [c for c, error in zip(candidates, errors, strict=True) if error.psnr_worst >= self.min_psnr]
        names = [DEFAULT_RASTERIZER] * len(candidates)
        if within:  # candidates are in the order of their processor times
            usual = within[0].options
            variants = [replace(within[0], options=usual._replace(**changes)) for changes in RASTERIZERS.values()]
            candidates, names = [*candidates, *variants], [*names, *RASTERIZERS]
            errors += self._errors(variants)
        photographs = [self._images_db(candidate) for candidate in candidates]
        background, on_repeat = self.job.info.background, self.job.progress("timing", REPEATS)
        times = time_frames(candidates, self._timed, background, on_repeat=on_repeat)
        memory = frame_memory(
            [c.path for c in candidates], SceneCamera("timed", self._timed[0].t, self._timed[0].camera)
        )
        parts = zip(candidates, names, times, errors, memory, photographs, strict=True)
        return [Point(*part) for part in parts]

    def _errors(self, candidates: list[Candidate]) -> list[RenderedError]:
        on_error = self.job.progress("all frames of the points", len(candidates))
        errors = []
        for candidate in candidates:
            errors.append(self.job.error(candidate))
            on_error()
        return errors

    def _images_db(self, candidate: Candidate) -> float | None:
        return self.images.psnr(candidate.session.gaussians, candidate.options) if self.images else None

    def _exact_images(self) -> float | None:
        return self.images.psnr(self.job.exact_pose, self.job.model.rasterizer) if self.images else None

    def _tell(self, what: str, calls: list[tuple[Callable[..., object], tuple]]) -> None:
        on_call = self.job.progress(what, len(calls))
        for function, arguments in calls:
            function(*arguments)
            on_call()


def same(a: Candidate, b: Candidate) -> bool:
    """Whether two candidates are the same scene: trimming to less may leave out no more."""
    return a.digest == b.digest

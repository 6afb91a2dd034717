"""The export with a plan that was asked for: no sweep, only pruning."""

import math
from contextlib import suppress

from msdgs_export.jobs.builder import CandidateBuilder
from msdgs_export.jobs.candidate import UNUSABLE, Candidate, Measured
from msdgs_export.jobs.fit_bytes import within_bytes
from msdgs_export.jobs.packing import METADATA_BYTES
from msdgs_export.jobs.pruned_models import pruning_levels
from msdgs_export.jobs.ruler import Ruler
from msdgs_export.target import Target, squared

PRUNING_PARTS = (1.0, 0.5, 0.25)
"""Of the squared error that a plan leaves, the parts that pruning is given, until the file is good enough."""


def planned(plan: str, builder: CandidateBuilder, ruler: Ruler, target: Target) -> Measured:
    """A candidate of the plan: of those that are allowed, the most pruned one; or the most exact if bytes alone are
    limited. Raises `TargetNotReached`."""
    whole = builder.candidate(plan, None)
    if target.max_bytes is None:
        measured, where = _within_error(whole, builder, ruler, target), f"the plan {plan} reaches"
    else:
        measured, where = _within_bytes(whole, builder, ruler, target), f"the plan {plan} reaches in so many bytes"
    return target.best(measured, where, lambda allowed: allowed[-1])


def _within_error(whole: Candidate, builder: CandidateBuilder, ruler: Ruler, target: Target) -> list[Measured]:
    """The whole plan, and if it leaves a part of the allowed error, one that is pruned as far as that allows."""
    unpruned = ruler.measured(whole)
    own = squared(unpruned.error.psnr_worst)
    budget = target.plan_part * (squared(target.min_psnr) - own)
    for part in PRUNING_PARTS if builder.pruning.rules and budget > 0 else ():
        with suppress(*UNUSABLE):  # then less is removed
            pruned = ruler.measured(builder.candidate(whole.plan, -10 * math.log10(part * budget)))
            if squared(pruned.error.psnr_worst) <= own + budget:
                return [unpruned, pruned]
    return [unpruned]


def _within_bytes(whole: Candidate, builder: CandidateBuilder, ruler: Ruler, target: Target) -> list[Measured]:
    """The plan at all levels of pruning that fit, the most pruned last; only the whole one if nothing has to go."""
    if target.bytes_only and target.fits(whole.size + METADATA_BYTES):
        return [ruler.measured(whole)]
    candidates = [whole]
    for level in pruning_levels(target) if builder.pruning.rules else ():
        with suppress(*UNUSABLE):
            candidates.append(builder.candidate(whole.plan, level))
    different = {candidate.digest: candidate for candidate in candidates}.values()
    return within_bytes(list(different), ruler, target, [])

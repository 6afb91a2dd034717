"""The model pruned to several PSNRs."""

import copy
import math
from collections.abc import Collection
from contextlib import suppress
from functools import cached_property

import numpy as np

from msdgs_export.bake import changing_outputs
from msdgs_export.jobs.checkpoint import Checkpoint
from msdgs_export.jobs.ruler import Ruler
from msdgs_export.measure.poses import posed
from msdgs_export.measure.rendered_error import within_memory
from msdgs_export.measure.views import selection_views
from msdgs_export.plans.base import BASELINE
from msdgs_export.plans.registry import build
from msdgs_export.precision.report import StabilityReport
from msdgs_export.pruning import PrunedModel, PruningMask, PruningStatistics, full_mask, prune, pruned
from msdgs_export.pruning.mask import NetworkMask, rows, unpruned
from msdgs_export.pruning.statistics import Poses
from msdgs_export.target import Target
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.scene.errors import InvalidInput, SceneFileInvalid
from msdgs_serve.scene.gaussians import Gaussians

SELECTION_TIMES, SELECTION_CAMERAS = 33, 3

PRUNING_STEPS = (10.0, 5.0, 2.0, -5.0, -10.0)
"""dB above or below `min_psnr` at which pruning is tried."""

SMALLER_STEPS = (-15.0, -20.0, -25.0)
"""The same, if bytes are limited too."""

MIN_PRUNING_DB = 25.0
"""Pruning isn't tried below it."""

BACK_OFFS = 4
"""Repeats of pruning with a smaller error, if its rules together cost more than each of them alone."""

BACK_OFF_DB = 0.5
ROUND_OFF_DB = 30.0
"""By how much frames in float32 must be better than what an export may add, so that pruning doesn't see round-off."""


def pruning_levels(target: Target) -> list[float]:
    """The PSNRs, dB, to which pruning is tried, the mildest first."""
    steps = PRUNING_STEPS + (SMALLER_STEPS if target.max_bytes is not None else ())
    return [target.min_psnr + step for step in steps if target.min_psnr + step >= MIN_PRUNING_DB]


def exact_in_float32(stability: StabilityReport, target: Target) -> bool:
    """Whether the round-off of the whole network in float32, which takes 0.6 of torch's time, is far below the error
    that the target allows."""
    limit = target.min_psnr + ROUND_OFF_DB
    return stability.stable and (stability.float32 is None or stability.float32.psnr >= limit)


class PrunedModels:
    """A model without what `rules` remove, by the PSNR that its worst frame keeps; each is made once."""

    def __init__(
        self, checkpoint: Checkpoint, ruler: Ruler, stability: StabilityReport, target: Target, rules: Collection[str]
    ) -> None:
        self.rules = rules
        self._checkpoint, self._model, self._ruler = checkpoint, checkpoint.model, ruler
        self._stable, self._in_float32 = stability.stable, exact_in_float32(stability, target)
        self._made: dict[float | None, PrunedModel] = {None: unpruned(self._model)}

    def at(self, pruning_db: float | None) -> PrunedModel:
        """The model without everything that can be removed while the worst frame stays at `pruning_db` dB.

        It is checked again in the evaluation views, at other times than the selection views; if it is worse there,
        pruning is repeated with a smaller error.
        """
        if pruning_db not in self._made:
            assert pruning_db is not None
            self._made[pruning_db] = self._checked(pruning_db) if self.rules else self._made[None]
        return self._made[pruning_db]

    def known_poses(self, network: NetworkMask) -> Poses | None:
        """Poses of all Gaussians by this part of the network, if pruning has computed them."""
        whole = full_mask(self._model).network
        return self._statistics.poses(whole) if self.rules and network == whole else None

    @cached_property
    def _statistics(self) -> PruningStatistics:
        """Visibility and motion by which pruning decides, computed on first use; in float64 if float32 overflows."""
        model, info, ruler = self._model, self._checkpoint.info, self._ruler
        views = selection_views(ruler.cameras, info.time_range, SELECTION_TIMES, SELECTION_CAMERAS)
        inputs = within_memory(views, len(model.gaussians)), info.background, ruler.track
        if self._in_float32:
            network = build(BASELINE, self._checkpoint.bake(self.at(None)))
            with suppress(SceneFileInvalid):  # it overflows at a time that stability didn't try
                session = DeformationSession("network in float32", contents=network.SerializeToString())
                return PruningStatistics(model, *inputs, lambda t: session.gaussians(t))
        fits = self._stable and not self._in_float32  # float32 doesn't overflow
        return PruningStatistics(model if fits else copy.deepcopy(model).double(), *inputs)

    def _checked(self, pruning_db: float) -> PrunedModel:
        min_db, statistics = pruning_db, self._statistics
        for _ in range(BACK_OFFS):
            on_rule = self._ruler.track(f"pruning to {pruning_db:g} dB", len(self.rules))
            mask, left_out = prune(statistics, min_db, self.rules, on_rule)
            if not left_out:
                break
            smaller = pruned(self._model, mask, statistics.poses(mask.network).static, left_out)
            worst_db = self._worst_db(mask, smaller)
            if worst_db >= pruning_db:
                return smaller
            min_db += pruning_db - worst_db + BACK_OFF_DB
        return self._made[None]

    def _worst_db(self, mask: PruningMask, pruned: PrunedModel) -> float:
        """PSNR of the worst evaluation frame of a pruned model. If its network is complete and only poses depend on
        time, moving Gaussians take those of the exact frames, and no layer is run again."""
        changes = mask.network != full_mask(self._model).network or changing_outputs(self._model)
        layers_run = mask.moves.any() and changes
        moving, exact = mask.ids[: len(pruned.moving.gaussians)], self._ruler.exact

        def pose(t: float) -> Gaussians:
            moved = posed(pruned.moving, t) if layers_run else rows(exact.kept(t), moving, mask.sh_degree)
            pairs = zip(vars(moved).values(), vars(pruned.static).values(), strict=True)
            return Gaussians(*(np.concatenate(pair).astype(np.float32) for pair in pairs))

        try:
            return exact.measure(pose, pruned.ids, on_frame=self._ruler.on_work).psnr_worst
        except InvalidInput:  # poses that overflow in float32
            return -math.inf

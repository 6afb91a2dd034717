"""The exports of one model file: candidates by plan, and the exact frames and pruning statistics that all use."""

import copy
import hashlib
import math
from collections.abc import Collection
from contextlib import closing, suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from export.bake import Baked, changing_outputs
from export.layers import HEADS
from export.measure.poses import in_float64, posed
from export.measure.rendered_error import ExactFrames, RenderedError, within_memory
from export.measure.views import cameras_of, evaluation_views, selection_views
from export.plans.base import BASELINE
from export.plans.registry import build, check_appearance, plan_of
from export.plans.single_poses import SinglePoses
from export.precision.assess import StabilityReport, assess
from export.progress import Track, no_progress
from export.pruning import RULES, PrunedModel, PruningMask, PruningStatistics, full_mask, prune, pruned
from export.pruning.mask import NetworkMask, bake_pruned, in_spatial_order, rows, unpruned, with_layers, with_sh_degree
from export.target import ADDED_DB, MIN_PSNR
from export.trajectories.sampling import Sampler, Trajectories, layers_digest
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.scene.errors import InvalidInput, SceneFileInvalid
from msdgs_serve.scene.gaussians import Gaussians
from msdgs_train.evaluation.metrics import MAX_PSNR
from msdgs_train.gaussians.model_file import load_model

if TYPE_CHECKING:
    from export.measure.images import HeldOutImages

EVALUATION_TIMES, CAMERAS_PER_TIME = 16, 3
SELECTION_TIMES, SELECTION_CAMERAS = 33, 3
ESTIMATE_STRIDE = 7
"""A quick estimate compares every 7th frame: no multiple of `CAMERAS_PER_TIME`, so not always the first of a time."""

BACK_OFFS = 4
"""Repeats of pruning with a smaller error, if its rules together cost more than each of them alone."""

BACK_OFF_DB = 0.5
STABILITY_TIMES = 8
ROUND_OFF_DB = 30.0
"""By how much frames in float32 must be better than what an export may add, so that pruning doesn't see round-off."""

SAMPLED_KEPT = 2
"""Sets of trajectories that are cached; one takes up to 2 GiB."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """A scene file that may be chosen as the export, and how it was made."""

    plan: str
    pruning_db: float | None  # dB, lowest PSNR of a frame that pruning alone may cause; None: not pruned
    pruned: PrunedModel
    path: Path
    float32: Path | None = None  # the same in float32, if the arrays of this file are packed

    @cached_property
    def session(self) -> DeformationSession:
        """The file, opened on first use."""
        return DeformationSession(self.path)

    @cached_property
    def digest(self) -> bytes:
        """SHA-256 of the file."""
        return hashlib.sha256(self.path.read_bytes()).digest()

    def close(self) -> None:
        """Release the memory of the open file."""
        self.__dict__.pop("session", None)

    @property
    def sh_degree(self) -> int:
        """SH degree of its colors."""
        return self.pruned.moving.config.sh_degree

    @property
    def size(self) -> int:
        """Size of the file in bytes."""
        return self.path.stat().st_size


class ExportJob:
    """Exports of one model file; candidates are written into `folder`."""

    def __init__(
        self,
        checkpoint: Path,
        folder: Path,
        *,
        min_psnr: float | None = None,
        max_bytes: int | None = None,
        rules: Collection[str] = tuple(RULES),
        packs: bool = True,
        images: "HeldOutImages | None" = None,
        progress: Track = no_progress,
    ) -> None:
        """`packs` is whether arrays may be stored in fewer bits. With `images`, errors are measured from their
        training cameras. Raises `CheckpointInvalid`."""
        self.folder, self.rules, self.packs, self.progress = folder, rules, packs, progress
        self._min_psnr, self.max_bytes, self.images = min_psnr, max_bytes, images
        self.on_work = progress("frames, and parts of poses", 0)
        model, self.info, _ = load_model(checkpoint)
        self.model = in_spatial_order(model)
        with checkpoint.open("rb") as file:
            self.sha256 = hashlib.file_digest(file, "sha256").hexdigest()
        self.cameras = cameras_of(self.info, images.training if images else ())
        self._files = 0
        self._pruned: dict[float | None, PrunedModel] = {None: unpruned(self.model)}
        self._sampled: list[tuple[bytes, np.ndarray, Trajectories]] = []

    @cached_property
    def exact(self) -> ExactFrames:
        """Frames in float64, computed on first use."""
        views = evaluation_views(self.cameras, self.info.time_range, EVALUATION_TIMES, CAMERAS_PER_TIME)
        views = within_memory(views, len(self.model.gaussians))
        on_frame = self.progress("exact frames in float64", len(views))
        pose, options = in_float64(self.model, self.on_work), self.model.rasterizer
        return ExactFrames(pose, views, self.info.background, options, on_frame, self.info.placement.scale)

    @cached_property
    def exact_images_psnr(self) -> float | None:
        """Mean PSNR of the exact frames against held-out images, dB; None if there are none."""
        return self.images.psnr(self.exact.pose, self.model.rasterizer) if self.images else None

    @cached_property
    def min_psnr(self) -> float:
        """PSNR of the worst frame, dB: the given one, or the smallest that adds no more than `ADDED_DB` to the error
        against held-out images, rounded up to a tenth, or `MIN_PSNR`. Squared errors add up."""
        if self._min_psnr is not None or self.exact_images_psnr is None:
            return MIN_PSNR if self._min_psnr is None else self._min_psnr
        added = 10 * math.log10(10 ** (ADDED_DB / 10) - 1)
        return min(math.ceil(10 * (self.exact_images_psnr - added)) / 10, MAX_PSNR)

    @property
    def required_psnr(self) -> float | None:
        """`min_psnr`, if the written file must have it: None if only its bytes are limited."""
        return self.min_psnr if self.max_bytes is None else self._min_psnr

    @cached_property
    def statistics(self) -> PruningStatistics:
        """Visibility and motion by which pruning decides, computed on first use; in float64 if float32 overflows."""
        views = selection_views(self.cameras, self.info.time_range, SELECTION_TIMES, SELECTION_CAMERAS)
        inputs = within_memory(views, len(self.model.gaussians)), self.info.background, self.progress
        if network := self.network:
            with suppress(SceneFileInvalid), closing(network):  # it overflows at a time that stability didn't try
                return PruningStatistics(self.model, *inputs, lambda t: network.session.gaussians(t))
        fits = self.stability.stable and not self.network  # float32 doesn't overflow
        return PruningStatistics(self.model if fits else copy.deepcopy(self.model).double(), *inputs)

    @cached_property
    def network(self) -> Candidate | None:
        """The whole network in float32, which takes 0.6 of torch's time; None if its round-off is near `min_psnr`."""
        report, limit = self.stability, self.min_psnr + ROUND_OFF_DB
        exact_enough = report.stable and (report.float32 is None or report.float32.psnr >= limit)
        return self.candidate(BASELINE, None) if exact_enough else None

    def pruned(self, pruning_db: float | None) -> PrunedModel:
        """The model without everything that can be removed while the worst frame stays at `pruning_db` dB.

        It is checked again in the evaluation views, at other times than the selection views; if it is worse there,
        pruning is repeated with a smaller error.
        """
        if pruning_db not in self._pruned:
            assert pruning_db is not None
            self._pruned[pruning_db] = self._checked_pruning(pruning_db) if self.rules else self._pruned[None]
        return self._pruned[pruning_db]

    def candidate(self, plan: str, pruning_db: float | None, sh_degree: int | None = None) -> Candidate:
        """Write a scene file. Raises `InvalidInput` for a plan that this scene can't have, `PlanUnsafe` for one whose
        round-off would be visible."""
        check_appearance(plan, changing_outputs(self.model))
        self.stability.require(plan)
        model = self.pruned(pruning_db)
        if plan_of(plan).counts_layers:
            model = with_layers(model, self.model)
        if sh_degree is not None:
            model = with_sh_degree(model, sh_degree)
        return self._written(plan, pruning_db, model)

    @cached_property
    def stability(self) -> StabilityReport:
        """Whether the layers are exact enough in float32, computed on first use."""
        return assess(self.model, self.info, min_psnr=self.min_psnr, times=STABILITY_TIMES, track=self.progress)

    def error(self, candidate: Candidate, every: int = 1) -> RenderedError:
        """The error of a candidate's frames against exact ones, of all frames or of every n-th."""
        return self.exact.measure(candidate.session.gaussians, candidate.pruned.ids, every=every, on_frame=self.on_work)

    def _checked_pruning(self, pruning_db: float) -> PrunedModel:
        min_db = pruning_db
        for _ in range(BACK_OFFS):
            on_rule = self.progress(f"pruning to {pruning_db:g} dB", len(self.rules))
            mask, left_out = prune(self.statistics, min_db, self.rules, on_rule)
            if not left_out:
                break
            mean_poses = self.statistics.poses(mask.network).static
            smaller = pruned(self.model, mask, mean_poses, left_out)
            worst_db = self._worst_db(mask, smaller)
            if worst_db >= pruning_db:
                return smaller
            min_db += pruning_db - worst_db + BACK_OFF_DB
        return self._pruned[None]

    def _worst_db(self, mask: PruningMask, pruned: PrunedModel) -> float:
        """PSNR of the worst evaluation frame of a pruned model. If its network is complete and only poses depend on
        time, moving Gaussians take those of the exact frames, and no layer is run again."""
        changes = mask.network != full_mask(self.model).network or changing_outputs(self.model)
        layers_run = mask.moves.any() and changes
        moving = mask.ids[: len(pruned.moving.gaussians)]

        def pose(t: float) -> Gaussians:
            moved = posed(pruned.moving, t) if layers_run else rows(self.exact.kept(t), moving, mask.sh_degree)
            pairs = zip(vars(moved).values(), vars(pruned.static).values(), strict=True)
            return Gaussians(*(np.concatenate(pair).astype(np.float32) for pair in pairs))

        try:
            return self.exact.measure(pose, pruned.ids, on_frame=self.on_work).psnr_worst
        except InvalidInput:  # poses that overflow in float32
            return -math.inf

    def _written(self, plan: str, pruning_db: float | None, pruned: PrunedModel) -> Candidate:
        self._files += 1
        path = self.folder / f"{self._files}.onnx"
        baked, sampled = bake_pruned(pruned, self.info, self.sha256), None
        if plan_of(plan).fitted and len(baked.moving):
            sampled = self._trajectories(baked, pruned)
        path.write_bytes(build(plan, baked, sampled).SerializeToString())
        return Candidate(plan, pruning_db, pruned, path)

    def _trajectories(self, baked: Baked, pruned: PrunedModel) -> Trajectories:
        """Trajectories of the moving Gaussians; sampled once, since pruning doesn't change their motion."""
        layers, ids = layers_digest(baked), pruned.ids[: len(baked.moving)]
        for known_layers, known, sampled in self._sampled:
            if known_layers == layers and np.isin(ids, known, assume_unique=True).all():
                return sampled.some(np.searchsorted(known, ids))
        resolved = 10 ** (-max(self.min_psnr, MIN_PSNR) / 10 - 1)
        inputs = baked, self.progress, [camera for _, camera in self.cameras], resolved
        sampled = None
        with suppress(SceneFileInvalid):  # as in `statistics`
            sampled = self.network and Trajectories(*inputs, self._sampler(baked, pruned.network, ids))
        sampled = sampled or Trajectories(*inputs)
        self._sampled = [*self._sampled[1 - SAMPLED_KEPT :], (layers, ids, sampled)]
        return sampled

    def _sampler(self, baked: Baked, network: NetworkMask, ids: np.ndarray) -> Sampler:
        """Poses of the moving Gaussians `ids` in float32, from the statistics at times that these have."""
        single, whole = SinglePoses(baked), full_mask(self.model).network
        known = self.statistics.poses(whole) if self.rules and network == whole else None

        def at(t: float, rows: np.ndarray) -> np.ndarray:
            if known is None or t not in known.times:
                return single.at(t, rows)
            return np.hstack([getattr(known.at(t), head)[ids[rows]] for head in HEADS])

        return at

"""The scene files of plans, each with a level of pruning and a degree of SH."""

from collections.abc import Collection
from pathlib import Path

from msdgs_export.bake import changing_outputs
from msdgs_export.jobs.candidate import Candidate
from msdgs_export.jobs.checkpoint import Checkpoint
from msdgs_export.jobs.pruned_models import PrunedModels, exact_in_float32
from msdgs_export.jobs.ruler import Ruler
from msdgs_export.jobs.shared_trajectories import SharedTrajectories
from msdgs_export.plans.registry import build, check_appearance, plan_of
from msdgs_export.precision.assess import assess
from msdgs_export.precision.report import StabilityReport
from msdgs_export.pruning import RULES
from msdgs_export.pruning.mask import with_layers, with_sh_degree
from msdgs_export.target import Target

STABILITY_TIMES = 8


class CandidateBuilder:
    """Writes candidates of one model into `folder`."""

    def __init__(
        self,
        checkpoint: Checkpoint,
        stability: StabilityReport,
        pruning: PrunedModels,
        trajectories: SharedTrajectories,
        folder: Path,
    ) -> None:
        self.model, self.pruning = checkpoint.model, pruning
        self._checkpoint, self._stability, self._trajectories = checkpoint, stability, trajectories
        self._folder, self._files = folder, 0

    @classmethod
    def of(
        cls, checkpoint: Checkpoint, ruler: Ruler, target: Target, folder: Path, rules: Collection[str] = tuple(RULES)
    ) -> "CandidateBuilder":
        """A builder whose candidates are pruned by `rules` and checked by `ruler`; assesses the model's stability."""
        model, info, track = checkpoint.model, checkpoint.info, ruler.track
        stability = assess(model, info, min_psnr=target.min_psnr, times=STABILITY_TIMES, track=track)
        pruning = PrunedModels(checkpoint, ruler, stability, target, rules)
        cameras, in_float32 = [camera for _, camera in ruler.cameras], exact_in_float32(stability, target)
        trajectories = SharedTrajectories(pruning, target, cameras, track, in_float32=in_float32)
        return cls(checkpoint, stability, pruning, trajectories, folder)

    def candidate(self, plan: str, pruning_db: float | None, sh_degree: int | None = None) -> Candidate:
        """Write a scene file. Raises `InvalidInput` for a plan that this scene can't have, `PlanUnsafe` for one whose
        round-off would be visible."""
        check_appearance(plan, changing_outputs(self.model, shading=False))
        self._stability.require(plan)
        pruned = self.pruning.at(pruning_db)
        if plan_of(plan).counts_layers:
            pruned = with_layers(pruned, self.model)
        if sh_degree is not None:
            pruned = with_sh_degree(pruned, sh_degree)
        baked, trajectories = self._checkpoint.bake(pruned), None
        check_appearance(plan, baked.scene.changing)
        if plan_of(plan).fitted and len(baked.moving):
            trajectories = self._trajectories.of(baked, pruned)
        self._files += 1
        path = self._folder / f"{self._files}.onnx"
        path.write_bytes(build(plan, baked, trajectories).SerializeToString())
        return Candidate(plan, pruning_db, pruned, path)

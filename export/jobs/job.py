"""One model file, and what all its exports share: exact frames, evidence for trimming, and candidates by plan."""

import hashlib
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from export.jobs.bake import Baked
from export.measure.rendered_error import ExactFrames, RenderedError, posed
from export.measure.stability import MIN_PSNR, StabilityReport, assess
from export.measure.views import cameras_of, deciding_views, measuring_views
from export.plans.registry import build, parse
from export.pruning import RULES, Cut, Evidence, TrimmedModel, trim, trimmed_model, whole
from export.pruning.bake import bake_trimmed
from export.pruning.mask import rows, untrimmed, with_sh_degree
from export.trajectories.sampling import SomeTrajectories, Trajectories, layers_digest
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.rasterizer import RasterizerOptions
from msdgs_serve.scene.camera import Camera
from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.scene.gaussians import Gaussians
from msdgs_train.gaussians.model_file import load_model

MEASURING_TIMES, CAMERAS_A_TIME = 16, 3
DECIDING_TIMES = 33
BACK_OFFS = 4
"""How often trimming is repeated more carefully where its parts together are worse than each promised."""

BACK_OFF_DB = 0.5
STABILITY_TIMES = 8
SAMPLED_KEPT = 2
"""Sets of trajectories that are kept; one takes up to 2 GiB."""

Progress = Callable[[str, int], Callable[[], object]]
"""Called with what begins and how many steps it has; returns what is to be called after each."""


class Unreachable(InvalidInput):
    """No export of this model is as close to it as was asked for."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """A scene file that could be the export, and how it was made."""

    plan: str
    trim_db: float | None  # what trimming alone may cost, dB on the worst frame; None: nothing was left out
    trimmed: TrimmedModel
    path: Path
    options: RasterizerOptions  # what it is drawn with

    @cached_property
    def session(self) -> DeformationSession:
        """The file, opened when it is first asked for."""
        return DeformationSession(self.path)

    @cached_property
    def digest(self) -> bytes:
        """Of the file."""
        return hashlib.sha256(self.path.read_bytes()).digest()

    def close(self) -> None:
        """Give back the memory of the open file."""
        self.__dict__.pop("session", None)

    @property
    def sh_degree(self) -> int:
        """Of its colors."""
        return self.trimmed.moving.config.sh_degree

    @property
    def size(self) -> int:
        """Bytes on disk."""
        return self.path.stat().st_size


def no_progress(what: str, steps: int) -> Callable[[], object]:
    """Tell nobody."""
    return lambda: None


class Job:
    """Exports of one model file; candidates are written into `folder`."""

    def __init__(
        self,
        checkpoint: Path,
        folder: Path,
        *,
        min_psnr: float = MIN_PSNR,
        rules: Collection[str] = tuple(RULES),
        training: Sequence[Camera] = (),
        progress: Progress = no_progress,
    ) -> None:
        """`training` are the cameras of the training images, where at hand. Raises `CheckpointInvalid`."""
        self.folder, self.min_psnr, self.rules, self.progress = folder, min_psnr, rules, progress
        self.model, self.info, _ = load_model(checkpoint)
        with checkpoint.open("rb") as file:
            self.sha256 = hashlib.file_digest(file, "sha256").hexdigest()
        self.cameras = cameras_of(self.info, training)
        self._files = 0
        self._trimmed: dict[float | None, TrimmedModel] = {None: untrimmed(self.model)}
        self._stability: StabilityReport | None = None
        self._evidence: Evidence | None = None
        self._sampled: list[tuple[bytes, np.ndarray, Trajectories]] = []
        self._exact: ExactFrames | None = None

    @property
    def exact(self) -> ExactFrames:
        """Frames in float64, computed when they are first asked for."""
        if self._exact is None:
            views = measuring_views(self.cameras, self.info.time_range, MEASURING_TIMES, CAMERAS_A_TIME)
            on_frame = self.progress("exact frames in float64", len(views))
            self._exact = ExactFrames(self.model, views, self.info.background, on_frame)
        return self._exact

    @property
    def evidence(self) -> Evidence:
        """What trimming decides by, computed when it is first asked for."""
        if self._evidence is None:
            views = deciding_views(self.cameras, self.info.time_range, DECIDING_TIMES)
            on_time = self.progress("what moves, and what is seen", DECIDING_TIMES)
            self._evidence = Evidence(self.model, views, self.info.background, on_time)
        return self._evidence

    def trimmed(self, trim_db: float | None) -> TrimmedModel:
        """The model without what `trim_db` dB on the worst frame allow to leave out.

        Frames of all rules together, at other times than those that decided, are held to it as well; where they
        are worse, trimming is repeated more carefully.
        """
        if trim_db not in self._trimmed:
            assert trim_db is not None
            self._trimmed[trim_db] = self._checked_trim(trim_db) if self.rules else self._trimmed[None]
        return self._trimmed[trim_db]

    def candidate(self, plan: str, trim_db: float | None, sh_degree: int | None = None) -> Candidate:
        """Write a scene file. Raises `InvalidInput` for a plan that this scene can't have, `PlanUnsafe` for one whose
        round-off would be seen."""
        self.stability.require(plan)
        trimmed = self.trimmed(trim_db)
        if sh_degree is not None:
            trimmed = with_sh_degree(trimmed, sh_degree)
        return self._written(plan, trim_db, trimmed)

    @property
    def stability(self) -> StabilityReport:
        """How far float32 is from float64 where layers run when a frame is served."""
        if self._stability is None:
            on_time = self.progress("stability of the layers", STABILITY_TIMES)
            found = assess(self.model, self.info, min_psnr=self.min_psnr, times=STABILITY_TIMES, on_time=on_time)
            self._stability = found
        return self._stability

    def exact_pose(self, t: float) -> Gaussians:
        """All Gaussians of the model in float64."""
        return self.exact.pose(t)

    def error(self, candidate: Candidate, every: int = 1) -> RenderedError:
        """How far its frames are from exact ones; all of those kept, or every n-th."""
        pose, ids = candidate.session.gaussians, candidate.trimmed.ids
        return self.exact.measure(pose, ids, options=candidate.options, every=every)

    def _checked_trim(self, trim_db: float) -> TrimmedModel:
        least_db = trim_db
        for _ in range(BACK_OFFS):
            on_rule = self.progress(f"trimming to {trim_db:g} dB", len(self.rules))
            cut, left_out = trim(self.evidence, least_db, self.rules, on_rule)
            if not left_out:
                break
            trimmed = trimmed_model(self.evidence, cut, left_out)
            worst_db = self._worst_db(cut, trimmed)
            if worst_db >= trim_db:
                return trimmed
            least_db += trim_db - worst_db + BACK_OFF_DB
        return self._trimmed[None]

    def _worst_db(self, cut: Cut, trimmed: TrimmedModel) -> float:
        """PSNR of the worst of the measured frames of a trimmed model. Where its layers are all that there were, what
        moves is where it was in the exact frames, and no layer is run again."""
        layers_changed = cut.moves.any() and cut.network != whole(self.model).network
        moving = cut.ids[: len(trimmed.moving.gaussians)]

        def pose(t: float) -> Gaussians:
            moved = posed(trimmed.moving, t) if layers_changed else rows(self.exact.kept(t), moving, 0)
            still = trimmed.still
            colors = rows(self.exact.kept(t), cut.ids, cut.sh_degree)
            parts = ("means", "quats", "scales")
            arrays = [np.concatenate([getattr(moved, part), getattr(still, part)]) for part in parts]
            return Gaussians(*(a.astype(np.float32) for a in (*arrays, colors.opacities, colors.sh)))

        return self.exact.measure(pose, trimmed.ids).psnr_worst

    def _written(self, plan: str, trim_db: float | None, trimmed: TrimmedModel) -> Candidate:
        self._files += 1
        path = self.folder / f"{self._files}.onnx"
        baked, sampled = bake_trimmed(trimmed, self.info, self.sha256), None
        if parse(plan).fitted and len(baked.moving):
            sampled = self._trajectories(baked, trimmed.ids[: len(baked.moving)])
        path.write_bytes(build(plan, baked, sampled).SerializeToString())
        return Candidate(plan, trim_db, trimmed, path, self.model.rasterizer)

    def _trajectories(self, baked: Baked, ids: np.ndarray) -> Trajectories:
        """Those of the model's Gaussians `ids`, ascending, sampled once: what is trimmed further moves as before."""
        layers = layers_digest(baked)
        for known_layers, known, sampled in self._sampled:
            if known_layers == layers and np.isin(ids, known, assume_unique=True).all():
                return SomeTrajectories(sampled, np.searchsorted(known, ids))
        sampled = Trajectories(baked, self._on_time(len(ids)))
        self._sampled = [*self._sampled[1 - SAMPLED_KEPT :], (layers, ids, sampled)]
        return sampled

    def _on_time(self, count: int) -> Callable[[int, int], object]:
        """Tells of sampling; where motion is fast there is more to do than was known, which is another step."""
        known, on_step = 0, self.progress("", 0)

        def on_time(done: int, total: int) -> None:
            nonlocal known, on_step
            if total != known:
                what = f"{count:,} trajectories" if not known else "faster ones, sampled more densely"
                known, on_step = total, self.progress(what, total - known)
            on_step()

        return on_time

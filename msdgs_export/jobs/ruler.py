"""The errors of candidates: their frames against those of the exact network, and against held-out images."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

from msdgs_export.jobs.candidate import Candidate, Measured
from msdgs_export.jobs.checkpoint import Checkpoint
from msdgs_export.measure.poses import in_float64
from msdgs_export.measure.rendered_error import ExactFrames, RenderedError, within_memory
from msdgs_export.measure.views import cameras_of, evaluation_views
from msdgs_export.progress import Track, no_progress

if TYPE_CHECKING:
    from msdgs_export.measure.images import HeldOutImages

EVALUATION_TIMES, CAMERAS_PER_TIME = 16, 3
ESTIMATE_STRIDE = 7
"""A quick estimate compares every 7th frame: no multiple of `CAMERAS_PER_TIME`, so not always the first of a time."""


class Ruler:
    """Measures candidates of one model. With `images`, errors are measured from their training cameras."""

    def __init__(self, checkpoint: Checkpoint, images: HeldOutImages | None = None, track: Track = no_progress) -> None:
        self._model, self._info, self._images = checkpoint.model, checkpoint.info, images
        self.track = track
        self.on_work = track("frames, and parts of poses", 0)
        self.background = checkpoint.info.background
        self.cameras = cameras_of(checkpoint.info, images.training if images else ())
        views = evaluation_views(self.cameras, checkpoint.info.time_range, EVALUATION_TIMES, CAMERAS_PER_TIME)
        self.views = within_memory(views, len(checkpoint.model.gaussians))

    @cached_property
    def exact(self) -> ExactFrames:
        """Frames in float64, computed on first use."""
        on_frame = self.track("exact frames in float64", len(self.views))
        pose, options = in_float64(self._model, self.on_work), self._model.rasterizer
        return ExactFrames(pose, self.views, self.background, options, on_frame, self._info.placement.scale)

    @cached_property
    def exact_images_psnr(self) -> float | None:
        """Mean PSNR of the exact frames against held-out images, dB; None if there are none."""
        return self._images.psnr(self.exact.pose, self._model.rasterizer) if self._images else None

    def error(self, candidate: Candidate, every: int = 1) -> RenderedError:
        """The error of a candidate's frames against exact ones, of all frames or of every n-th."""
        return self.exact.measure(candidate.session.gaussians, candidate.pruned.ids, every=every, on_frame=self.on_work)

    def measured(self, candidate: Candidate) -> Measured:
        """A candidate with the error of all of its frames."""
        return Measured(candidate, self.error(candidate))

    def images_psnr(self, candidate: Candidate) -> float | None:
        """Mean PSNR of a candidate's frames against held-out images, dB; None if there are none."""
        return self._images.psnr(candidate.session.gaussians, self._model.rasterizer) if self._images else None

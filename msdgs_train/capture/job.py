"""A capture from recordings to a dataset and its report, in steps that are kept."""

import re
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.capture.dataset import write_dataset
from msdgs_train.capture.frame_set import FrameSet
from msdgs_train.capture.frames import check_amounts, open_source, starts, take_frames
from msdgs_train.capture.masked_poses import MASKS, POSES, MaskedPoses, find_masked_poses
from msdgs_train.capture.measures import measure_frames, measure_poses
from msdgs_train.capture.offsets import find_offsets
from msdgs_train.capture.progress import Progress
from msdgs_train.capture.recordings import WORK, claim, digest_of, held, require_disk, required_bytes
from msdgs_train.capture.report import Report, write_report
from msdgs_train.capture.sparse_model import FORMAT
from msdgs_train.capture.steps import Steps, Watch
from msdgs_train.capture.verdict import Verdict, judge, judge_frames
from msdgs_train.settings import require_seed

STEPS: dict[str, tuple[str, ...]] = {
    "frames": (),
    POSES: (),
    MASKS: (),
    "dataset": ("images", "motion_masks", "times.json", "sparse"),
    "report": ("capture.json", "capture.html"),
}
"""The steps, and what they put into the dataset's folder. A dataset is one once it has `sparse`."""

FRAMES, IMAGES = "frames.json", "images"


@dataclass(frozen=True)
class CaptureOptions:
    """What a capture's result depends on, beside its recordings."""

    frames: int = 300
    """Frames to take of the longest recording."""
    size: int = 1024
    """Longer side of the frames in pixels; smaller videos keep theirs."""
    offsets: tuple[float, ...] | None = None
    """Seconds by which each recording starts after the first one; found by sound if not given."""
    seed: int = 0

    def __post_init__(self) -> None:
        check_amounts(self.frames, self.size)
        require_seed("seed", self.seed)


class Outcome(NamedTuple):
    """What came of a capture."""

    verdict: Verdict
    notes: tuple[str, ...]
    """What people should know of the recordings, each a sentence."""


class CaptureJob:
    """The capture of some recordings into the folder `data`."""

    def __init__(
        self,
        recordings: Sequence[Path],
        data: Path,
        options: CaptureOptions,
        *,
        threads: int | None = None,
        force_step: str | None = None,
        watch: Watch,
    ) -> None:
        """Raises `InvalidInput` if `data` holds anything else, `CaptureFailed` if a recording can't be read."""
        if threads is not None and threads < 1:
            raise InvalidInput("threads", "1 or more", threads)
        starts(recordings, options.offsets)
        self.recordings, self.data, self.options, self.threads = recordings, data, options, threads
        self._sources = [open_source(recording, options.size) for recording in recordings]
        self.required_bytes = required_bytes(self._sources, options.frames)
        digest = digest_of(recordings)
        claim(data, digest)
        self.steps = Steps(STEPS, data / WORK, digest, force=force_step, watch=watch)

    def run(self) -> Outcome:
        """Do the steps that aren't done. Without a scene there is no dataset, but a report.

        Raises `CaptureFailed` if the disk lacks space, or a recording can't be read, `InvalidInput` if another process
        captures into the folder.
        """
        with held(self.data):
            return self._run()

    def _run(self) -> Outcome:
        require_disk(self.data, self.required_bytes)
        self.steps.do("frames", self._without_seed(), self._take_frames)
        frames = FrameSet.load(self.steps.path("frames") / FRAMES)
        measures, found = measure_frames(frames), None
        if judge_frames(measures).level != "no scene":
            found = find_masked_poses(self._images, frames, self._keep, seed=self.options.seed, threads=self.threads)
            measures = measure_poses(measures, frames, found.poses, found.moving)
        verdict = judge(measures)
        if found is not None and verdict.level != "no scene":
            self._write_dataset(frames, found)
        report = Report(frames, measures, verdict, self._images, found)
        self.steps.do("report", {}, lambda folder, progress: write_report(report, folder, progress))
        return Outcome(verdict, frames.notes)

    @property
    def _images(self) -> Path:
        return self.steps.path("frames") / IMAGES

    def _without_seed(self) -> dict[str, Any]:
        return {name: value for name, value in asdict(self.options).items() if name != "seed"}

    def _take_frames(self, folder: Path, progress: Progress) -> None:
        offsets, notes = self.options.offsets, []
        if offsets is None and len(self.recordings) > 1:
            found = find_offsets(self.recordings)
            offsets, notes = found.seconds, [found.note]
        frames = take_frames(
            self._sources,
            folder / IMAGES,
            frames=self.options.frames,
            offsets=offsets,
            progress=lambda done, total: progress("reading", done, total),
        )
        notes = tuple(self._without_names(note) for note in (*notes, *frames.notes))
        replace(frames, notes=notes).save(folder / FRAMES)

    def _without_names(self, note: str) -> str:
        """A sentence with numbers for the recordings' names, which may tell when and with what they were made."""
        for number, recording in enumerate(self.recordings, start=1):
            note = re.sub(rf"(?<!\w){re.escape(recording.name)}(?!\w)", f"recording {number}", note, count=1)
        return note

    def _keep(self, name: str, run: Callable[[Path, Progress], None]) -> Path:
        self.steps.do(name, {"seed": self.options.seed, "format": FORMAT}, run)
        return self.steps.path(name)

    def _write_dataset(self, frames: FrameSet, found: MaskedPoses) -> None:
        self.steps.do(
            "dataset",
            {},
            lambda folder, progress: write_dataset(
                self._images, frames, found.poses, found.masks, folder, progress=progress
            ),
        )

"""A capture from recordings to a dataset and its report, in steps that are kept."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.writing import write_text
from msdgs_train.capture.dataset import write_dataset
from msdgs_train.capture.frame_set import FrameSet
from msdgs_train.capture.frames import extract_frames
from msdgs_train.capture.measures import Measures, measure_frames, measure_poses
from msdgs_train.capture.moving import find_moving
from msdgs_train.capture.poses import Poses, find_poses
from msdgs_train.capture.recordings import WORK, claim, digest_of, require_disk, required_bytes
from msdgs_train.capture.report import Report, write_report
from msdgs_train.capture.steps import Progress, Steps, Watch
from msdgs_train.capture.verdict import Verdict, judge, judge_frames

STEPS = {
    "frames": (),
    "poses": (),
    "masks": (),
    "poses-again": (),
    "dataset": ("images", "motion_masks", "times.json", "sparse"),
    "report": ("capture.json", "capture.html"),
}
"""The steps, and what they put into the dataset's folder. A dataset is one once it has `sparse`."""

FRAMES, IMAGES, MASKS, MOVING = "frames.json", "images", "masks", "moving.json"


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
        for name, value in (("frames", self.frames), ("size", self.size)):
            if value < 1:
                raise InvalidInput(name, "1 or more", value)


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
        """Raises `InvalidInput` if `data` holds anything else, `CaptureFailed` if its disk lacks space."""
        self.recordings, self.data, self.options, self.threads = recordings, data, options, threads
        digest = digest_of(recordings)
        claim(data, digest)
        require_disk(data, required_bytes(len(recordings) * options.frames, options.size))
        self.steps = Steps(STEPS, data / WORK, digest, force=force_step, watch=watch)

    def run(self) -> Verdict:
        """Do the steps that aren't done, and return the verdict. Without a scene there is no dataset, but a report.

        Raises `CaptureFailed` if a recording can't be read.
        """
        options = asdict(self.options)
        seed = {"seed": options.pop("seed")}
        self.steps.do("frames", options, self._take_frames)
        frames = FrameSet.load(self.steps.path("frames") / FRAMES)
        measures, poses = measure_frames(frames), None
        if judge_frames(measures).level != "no scene":
            self.steps.do("poses", seed, lambda folder, progress: self._find_poses(frames, folder, progress, None))
            poses = Poses.load(self.steps.path("poses"), frames)
            if poses.registered:
                poses = self._without_what_moves(frames, poses, seed)
            measures = measure_poses(measures, frames, poses, self._moving())
        verdict = judge(measures)
        if poses is not None and verdict.level != "no scene":
            self.steps.do("dataset", {}, lambda folder, progress: self._write_dataset(frames, poses, folder, progress))
        self._report(frames, poses, measures, verdict)
        return verdict

    @property
    def _images(self) -> Path:
        return self.steps.path("frames") / IMAGES

    @property
    def _masks(self) -> Path:
        return self.steps.path("masks") / MASKS

    def _moving(self) -> dict[str, float]:
        file = self.steps.path("masks") / MOVING
        return json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}

    def _take_frames(self, folder: Path, progress: Progress) -> None:
        frames = extract_frames(
            self.recordings,
            folder / IMAGES,
            frames=self.options.frames,
            size=self.options.size,
            offsets=self._offsets(),
            progress=lambda done, total: progress("reading", done, total),
        )
        frames.save(folder / FRAMES)

    def _offsets(self) -> Sequence[float] | None:
        if self.options.offsets is None and len(self.recordings) > 1:
            return find_offsets(self.recordings)
        return self.options.offsets

    def _find_poses(self, frames: FrameSet, folder: Path, progress: Progress, masks: Path | None) -> None:
        find_poses(
            self._images,
            frames,
            folder,
            masks=masks,
            seed=self.options.seed,
            threads=self.threads,
            progress=progress,
        )

    def _without_what_moves(self, frames: FrameSet, first: Poses, seed: dict[str, int]) -> Poses:
        """Find what moves, and poses without it; return the better poses."""
        self.steps.do("masks", {}, lambda folder, progress: self._find_moving(frames, first, folder, progress))
        self.steps.do(
            "poses-again", seed, lambda folder, progress: self._find_poses(frames, folder, progress, self._masks)
        )
        return better(first, Poses.load(self.steps.path("poses-again"), frames))

    def _find_moving(self, frames: FrameSet, poses: Poses, folder: Path, progress: Progress) -> None:
        shares = find_moving(self._images, frames, poses, folder / MASKS, progress=progress)
        write_text(folder / MOVING, json.dumps(shares, indent=1) + "\n")

    def _write_dataset(self, frames: FrameSet, poses: Poses, folder: Path, progress: Progress) -> None:
        write_dataset(self._images, frames, poses, self._masks, folder, progress=progress)

    def _report(self, frames: FrameSet, poses: Poses | None, measures: Measures, verdict: Verdict) -> None:
        report = Report(
            frames,
            measures,
            verdict,
            self._moving(),
            self._images,
            self._masks,
            None if poses is None else poses.summary,
        )
        self.steps.do("report", {}, lambda folder, progress: write_report(report, folder, progress))


def better(first: Poses, second: Poses) -> Poses:
    """The second poses if they have more frames, or as many with a smaller reprojection error."""
    key = [(len(poses.registered), -poses.summary.error) for poses in (first, second)]
    return second if key[1] > key[0] else first

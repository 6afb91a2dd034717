"""`msdgs-train capture`."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Literal

import tyro

from msdgs_serve.process import EXIT_INVALID
from msdgs_serve.scene.errors import InvalidInput, MsdgsError
from msdgs_train.cli.console import console, progress_bar
from msdgs_train.settings import optional

RECORDINGS_AND_DATA = tyro.conf.arg(metavar="IN... DATA", help_behavior_hint="(one or more, then one)")
PACKAGES = ("av", "cv2", "pycolmap", "scipy")
"""Of the extra `capture`."""
Step = Literal["frames", "poses", "masks", "dataset", "report"]


@dataclass(frozen=True)
class Capture:
    """Make a dataset of a video of one's own: sharp frames with their times, camera poses, masks of what moves.

    IN is a video, or a folder of images, of a camera that moves around the scene; or several of the same moments, a
    camera each. DATA is the folder to create: a COLMAP dataset with times.json, and capture.html, which shows what was
    found and says whether it suffices for a scene, or what to record differently. It shows pictures of the recording.

    Steps are frames, poses, masks of what moves, dataset and report. Ctrl-C loses the one under way; the same command
    continues, and repeats what other options change.

    One moving camera:  msdgs-train capture clip.mp4 data/clip

    Several:  msdgs-train capture cam1.mp4 cam2.mp4 cam3.mp4 data/rig

    Times for a dataset of ns-process-data or COLMAP:  msdgs-train capture --times-from clip.mp4 data/scene

    Needs msdgs[capture].
    """

    paths: Annotated[tuple[Path, ...], tyro.conf.Positional, RECORDINGS_AND_DATA]
    """Recordings, and the folder to create."""
    frames: int = 300
    """Frames to take: the sharpest of each of so many intervals."""
    size: int = 1024
    """Longer side of the frames in pixels."""
    offsets: Annotated[tuple[float, ...] | None, optional("SECONDS...")] = None
    """By which each recording starts after the first one, one number each; found by their sound if not given."""
    seed: int = 0
    """Seed of the search for poses."""
    threads: Annotated[int | None, optional("INT")] = None
    """Threads; all processors if not given. With one the same seed gives the same poses."""
    force_step: Annotated[Step | None, optional("STEP")] = None
    """Repeat this step and those that follow."""
    times_from: Annotated[Path | None, optional("IN")] = None
    """Only write times.json to DATA, an existing dataset whose images are frames of this video."""

    def execute(self) -> int:
        *recordings, data = self.paths or (Path(),)
        if not self.paths or bool(recordings) == bool(self.times_from):
            expected = "DATA alone with --times-from" if self.times_from else "one recording or more, then DATA"
            raise InvalidInput("IN... DATA", expected, " ".join(map(str, self.paths)) or "nothing")
        for package in PACKAGES:
            if find_spec(package) is None:
                raise CaptureNotInstalled(f"msdgs-train capture needs {package}: pip install 'msdgs[capture]'")
        return self._times(data) if self.times_from else self._capture(recordings, data)

    def _times(self, data: Path) -> int:
        from msdgs_train.capture.times_from import times_from

        assert self.times_from is not None
        times_from(self.times_from, data)
        console.print(f"wrote {data / 'times.json'}; next: msdgs-train fit {data} RUN", soft_wrap=True)
        return 0

    def _capture(self, recordings: list[Path], data: Path) -> int:
        from msdgs_train.capture.job import CaptureJob, CaptureOptions
        from msdgs_train.capture.recordings import gigabytes

        options = CaptureOptions(self.frames, self.size, self.offsets, self.seed)
        job = CaptureJob(
            recordings, data, options, threads=self.threads, force_step=self.force_step, watch=watched_step
        )
        console.print(f"takes up to {gigabytes(job.required_bytes)} of disk in {data}", soft_wrap=True)
        verdict, notes = job.run()
        for note in notes:
            console.print(note, soft_wrap=True, highlight=False)
        console.print(verdict.text, soft_wrap=True, highlight=False)
        console.print(f"wrote {data / 'capture.html'}, with pictures of the recording", soft_wrap=True)
        if verdict.level == "no scene":
            return EXIT_INVALID
        console.print(f"next: msdgs-train fit {data} RUN --minutes 30", soft_wrap=True)
        return 0


class CaptureNotInstalled(MsdgsError):
    """A package of the extra `capture` is missing; the message names it."""


@contextmanager
def watched_step(name: str, is_kept: bool) -> "Iterator[Callable[[str, int, int], None]]":
    """A progress bar of a step of a capture, and a line at its end."""
    with progress_bar() as bar:
        task = bar.add_task(name, total=None)
        yield lambda stage, done, total: bar.update(task, description=f"{name}: {stage}", completed=done, total=total)
    console.print(f"{name}: {'kept' if is_kept else 'done'}")

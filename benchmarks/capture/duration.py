"""Seconds and memory of each step of a capture."""

import os
import re
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Annotated, NamedTuple

import av
import tyro

from benchmarks.measuring import machine, report_console, table
from msdgs_serve.writing import scratch_folder
from msdgs_train.capture.job import CaptureJob, CaptureOptions
from msdgs_train.capture.progress import Progress
from tests.support.clips import moving_camera_clip

ARC, RATE = 60.0, 30.0  # degrees, frames per second
SAMPLE_SECONDS = 0.1
"""Between two looks at the memory."""


class StepCost(NamedTuple):
    """What a step took."""

    name: str
    seconds: float
    processor_seconds: float  # of all threads, and of the processes that it starts
    peak_bytes: int  # resident memory of this process and its children, the largest sample


def main(
    video: Annotated[Path | None, tyro.conf.Positional] = None,
    frames: int = 300,
    size: int = 1024,
    long_side: int | None = None,
    threads: int | None = None,
    check: bool = False,
) -> int:
    """Capture a video and print seconds and the largest memory of each step (Linux).

    Without VIDEO a camera moves around moving toys, and a third of its image moves.

    Args:
        video: A video of one's own.
        frames: Frames of the clip, and frames to take.
        size: Longer side of the frames that are taken, and of the clip, in pixels.
        long_side: Enlarge the clip to this, as H.264 of 10 bits: 3840 for 4K.
        threads: Of COLMAP; all if not given.
        check: Test this benchmark with a tiny clip.
    """
    if check:
        return main(frames=14, size=160, long_side=320, threads=1)
    with scratch_folder() as folder:
        if video is None:
            video = moving_camera_clip(folder / "clip.mp4", width=size, frames=frames, rate=RATE, arc=ARC).file
            if long_side is not None:
                video = enlarged(video, folder / "large.mp4", long_side)
        costs, told = captured(video, folder / "data", CaptureOptions(frames, size), threads)
        title = f"{frames} frames of {size} px of {dimensions(video)}, {threads or 'all'} threads"
    made = table(title, "step", "seconds", "processor seconds", "peak memory, GB")
    for cost in [*costs, total(costs)]:
        seconds = [f"{each:.0f}" for each in (cost.seconds, cost.processor_seconds)]
        made.add_row(cost.name, *seconds, f"{cost.peak_bytes / 1e9:.2f}")
    report_console().print(machine(), told, made)
    return 0


def total(costs: list[StepCost]) -> StepCost:
    """The sum of the times, and the largest memory."""
    seconds, processor_seconds = (sum(each) for each in list(zip(*costs, strict=True))[1:3])
    return StepCost("all", seconds, processor_seconds, max(cost.peak_bytes for cost in costs))


def captured(video: Path, data: Path, options: CaptureOptions, threads: int | None) -> tuple[list[StepCost], str]:
    """The costs of the steps in their order, and the verdict."""
    costs: list[StepCost] = []

    @contextmanager
    def watch(name: str, is_kept: bool) -> Iterator[Progress]:
        start, before = time.perf_counter(), _processor_seconds()
        with PeakMemory() as memory:
            yield lambda stage, done, total: None
        seconds, used = time.perf_counter() - start, _processor_seconds() - before
        costs.append(StepCost(name, seconds, used, memory.peak_bytes))
        print(costs[-1], file=sys.stderr, flush=True)

    verdict = CaptureJob([video], data, options, threads=threads, watch=watch).run().verdict
    return costs, verdict.text


class PeakMemory:
    """The largest resident memory of this process and its children while the block runs."""

    def __enter__(self) -> "PeakMemory":
        self.peak_bytes, self._ended = 0, threading.Event()
        self._thread = threading.Thread(target=self._look, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._ended.set()
        self._thread.join()

    def _look(self) -> None:
        while True:
            self.peak_bytes = max(self.peak_bytes, sum(map(_resident_bytes, ["self", *_children()])))
            if self._ended.wait(SAMPLE_SECONDS):
                return


def _processor_seconds() -> float:
    """Of this process and of its children that have ended."""
    return sum(os.times()[:4])


def _children() -> list[str]:
    tasks = Path("/proc/self/task").iterdir()
    return [child for task in tasks for child in _text(task / "children").split()]


def _resident_bytes(process: str) -> int:
    found = re.search(r"^VmRSS:\s+(\d+) kB", _text(Path("/proc") / process / "status"), re.MULTILINE)
    return int(found[1]) << 10 if found else 0


def _text(file: Path) -> str:
    """Of a process or thread; nothing once it has ended."""
    try:
        return file.read_text()
    except (FileNotFoundError, ProcessLookupError):
        return ""


def enlarged(source: Path, target: Path, long_side: int) -> Path:
    """Write a video with this longer side as H.264 of 10 bits."""
    with av.open(str(source)) as old, av.open(str(target), "w") as new:
        shown = old.streams.video[0]
        scale = long_side / max(shown.width, shown.height)
        options = {"preset": "ultrafast", "crf": "22"}
        stream = new.add_stream("libx264", rate=Fraction(RATE), options=options)
        stream.width, stream.height = (2 * round(scale * side / 2) for side in (shown.width, shown.height))
        stream.pix_fmt = "yuv420p10le"
        for frame in old.decode(shown):
            new.mux(stream.encode(frame.reformat(stream.width, stream.height, stream.pix_fmt)))
        new.mux(stream.encode())
    return target


def dimensions(video: Path) -> str:
    """A video's size in words."""
    with av.open(str(video)) as opened:
        stream = opened.streams.video[0]
        return f"{stream.width}×{stream.height} {stream.codec_context.name}"


if __name__ == "__main__":
    sys.exit(tyro.cli(main))

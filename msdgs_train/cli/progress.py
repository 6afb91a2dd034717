"""What a run shows while it goes on: a progress bar, and Ctrl-C turned into a clean stop."""

import contextlib
import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any, Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from msdgs_train.comparison.matrix import Run
from msdgs_train.comparison.pools import RunEnd
from msdgs_train.engine.run import Observer, RunResult
from msdgs_train.engine.trainer import StepResult
from msdgs_train.evaluation.metrics import ImageMetrics

UPDATE_SECONDS = 0.5
PLAIN_LINE_SECONDS = 10.0  # between lines where the output is not a terminal


class FitProgress(Observer):
    """A bar with loss, PSNR, Gaussians and speed; lines where there is no terminal. The first Ctrl-C asks the run to
    stop after its step, the second one breaks it off."""

    def __init__(self, console: Console, steps: int) -> None:
        self._console = console
        self._steps = steps
        self._stop = threading.Event()
        self._first: tuple[int, float] | None = None
        self._next_update = 0.0
        self._old_handler: Any = None
        self._bar = Progress(
            BarColumn(None),
            MofNCompleteColumn(),
            TextColumn("{task.fields[state]}"),
            TimeElapsedColumn(),
            TimeRemainingColumn(elapsed_when_finished=True),
            console=console,
            disable=not console.is_terminal,
        )
        self._task = self._bar.add_task("fit", total=steps, state="reading images, compiling kernels")

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            self._old_handler = signal.signal(signal.SIGINT, self._on_interrupt)
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()
        if self._old_handler is not None:
            signal.signal(signal.SIGINT, self._old_handler)

    def step(self, result: StepResult, seconds: float) -> None:
        now = time.perf_counter()
        if self._first is None:
            self._first = (result.step, now)
        if now < self._next_update and result.step < self._steps:
            return
        self._next_update = now + (UPDATE_SECONDS if self._console.is_terminal else PLAIN_LINE_SECONDS)
        speed = (result.step - self._first[0]) / max(now - self._first[1], 1e-9)
        state = (
            f"loss {result.loss:.4f}  PSNR {result.psnr:.2f} dB  {result.gaussians:,} Gaussians  {speed:.1f} steps/s"
            + (f"  {result.skipped} skipped" if result.skipped else "")
        )
        self._bar.update(self._task, completed=result.step, state=state)
        if not self._console.is_terminal:
            left = (self._steps - result.step) / speed if speed else 0.0
            self._console.print(f"step {result.step:,}/{self._steps:,}  {state}  {left:.0f} s left", soft_wrap=True)

    def evaluation(self, step: int, split: str, metrics: ImageMetrics) -> None:
        self._console.print(
            f"step {step:,}: {split} PSNR {metrics.psnr:.2f} dB, SSIM {metrics.ssim:.4f}", soft_wrap=True
        )

    def rolled_back(self, reason: str, step: int, lr_factor: float) -> None:
        self._console.print(
            f"{reason}; going back to step {step:,} with learning rates times {lr_factor:g}",
            style="yellow",
            soft_wrap=True,
        )

    def should_stop(self) -> bool:
        return self._stop.is_set()

    def _on_interrupt(self, number: int, frame: FrameType | None) -> None:
        if self._stop.is_set():
            raise KeyboardInterrupt
        self._stop.set()


def print_outcome(console: Console, outcome: RunResult, data: Path, run: Path) -> None:
    """How a run has ended, what it has left, and how to go on with it."""
    console.print(
        f"{outcome.status} at step {outcome.step:,}, {outcome.gaussians:,} Gaussians, {outcome.seconds:.0f} s"
    )
    for split, metrics in outcome.metrics.items():
        console.print(f"{split:>5}: PSNR {metrics.psnr:.2f} dB, SSIM {metrics.ssim:.4f}")
    console.print(f"model: {run / 'model.pt'}", soft_wrap=True)
    if outcome.best is not None:
        best = outcome.best
        console.print(f"best:  {run / 'best.pt'}, {best.split} {best.psnr:.2f} dB, step {best.step:,}")
    if outcome.status != "finished":
        more = " --max-minutes None" if outcome.status == "out of time" else ""
        console.print(f"go on with: msdgs-train fit {data} {run} --resume{more}", soft_wrap=True)


class ComparisonProgress:
    """A bar over the runs of a comparison, and a line for each that has ended."""

    def __init__(self, console: Console, total: int) -> None:
        self._console = console
        self._bar = Progress(
            BarColumn(None), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn(),
            console=console, disable=not console.is_terminal,
        )  # fmt: skip
        self._task = self._bar.add_task("runs", total=total)

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def ended(self, run: Run, ended: RunEnd) -> None:
        """A run is over, one way or another."""
        self._bar.advance(self._task)
        line = f"{run.name}: {ended.status}" + (f", {ended.message}" if ended.message else "")
        self._console.print(line, soft_wrap=True, markup=False, style="red" if ended.status == "failed" else None)


@contextlib.contextmanager
def frame_progress(console: Console, total: int) -> Iterator[Callable[[int, int], None]]:
    """A bar over frames; yields a function of (done, total)."""
    with Progress(console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task("frames", total=total)
        yield lambda done, of: bar.update(task, completed=done, total=of)

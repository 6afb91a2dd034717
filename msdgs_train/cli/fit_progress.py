"""Terminal output of `msdgs-train fit`: phases, a progress bar, metrics, and Ctrl-C as a clean stop."""

import contextlib
import math
import shlex
import threading
import time
from pathlib import Path
from types import FrameType
from typing import Any, Self

from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from msdgs_serve.process import stopped_by
from msdgs_train.cli.console import console, progress_bar
from msdgs_train.datasets.common.summary import summary
from msdgs_train.engine.observer import Observer
from msdgs_train.engine.run import RunResult
from msdgs_train.engine.run_record import BEST, MODEL
from msdgs_train.engine.trainer import StepResult, Trainer
from msdgs_train.evaluation.metrics import ImageMetrics
from msdgs_train.systems.base import RaySystem

UPDATE_SECONDS = 0.5
PLAIN_LINE_SECONDS = 10.0  # between lines if the output is not a terminal
NOT_ALL_KEPT = (
    "warning: decoded images take {needed:.1f} GiB, of which {kept:g} stay in memory. The others are read and decoded "
    "again whenever they are drawn: --image-memory {all} keeps all, and a smaller --size needs less"
)


class FitProgress(Observer):
    """Shows a bar with loss, PSNR, Gaussians and speed, or prints lines if the output is not a terminal.

    The first Ctrl-C stops the run after the current step, the second one at once; so do the signals that end a process
    or tell that its terminal was closed. Training goes on if the output can't be written, as when a pager has ended.
    """

    def __init__(self, steps: int) -> None:
        self._steps = steps
        self.elements = "Gaussians"
        """What the model is made of."""
        self._stop = threading.Event()
        self._first: tuple[int, float] | None = None  # step and time that the speed is measured from
        self._taken = 0  # optimizer steps since then; with `minutes` each stands for several steps of the schedule
        self._next_update = 0.0
        self._signals = stopped_by(self._on_interrupt)
        state, left = TextColumn("{task.fields[state]}"), TimeRemainingColumn(elapsed_when_finished=True)
        self._bar = progress_bar(BarColumn(None), MofNCompleteColumn(), state, TimeElapsedColumn(), left)
        self._task = self._bar.add_task("fit", total=steps, state="reading images, compiling kernels")

    def __enter__(self) -> Self:
        self._signals.__enter__()
        self._bar.start()
        return self

    def __exit__(self, *error: Any) -> None:
        with contextlib.suppress(OSError, SystemExit):
            self._bar.stop()
        self._signals.__exit__(*error)

    def on_train_start(self, trainer: Trainer) -> None:
        self._print(summary(trainer.scene, trainer.background))
        for warning in trainer.scene.warnings:
            self._print(f"warning: {warning}", style="yellow")
        if isinstance(trainer.system, RaySystem):
            self.elements, phases = "vertices", []
        else:
            phases = trainer.schedule.phases()
            run, needed = trainer.config.run, trainer.bytes_of_images / 2**30
            kept = run.image_memory if run.device == "cpu" else max(run.image_memory, run.gpu_image_memory)
            if needed > kept:
                self._print(NOT_ALL_KEPT.format(needed=needed, kept=kept, all=math.ceil(needed)), style="yellow")
        width = max((len(phase.name) for phase in phases), default=0)
        for phase in phases:
            self._print(f"{phase.name:{width}}  steps {phase.first + 1:,} to {phase.stop:,}")
        if trainer.step_count:
            self._print(f"resumed after step {trainer.step_count:,}")

    def step(self, result: StepResult, seconds: float) -> None:
        now = time.perf_counter()
        if self._first is None:
            self._first, self._taken = (result.step, now), -1
        self._taken += 1
        if now < self._next_update and result.step < self._steps:
            return
        self._next_update = now + (UPDATE_SECONDS if console.is_terminal else PLAIN_LINE_SECONDS)
        elapsed = max(now - self._first[1], 1e-9)
        pace = (result.step - self._first[0]) / elapsed
        state = f"loss {result.loss:.4f}  PSNR {result.psnr:.2f} dB  {result.gaussians:,} {self.elements}"
        state += f"  {self._taken / elapsed:.1f} steps/s" if self._taken else ""
        state += f"  {result.skipped} skipped" if result.skipped else ""
        self._bar.update(self._task, completed=result.step, state=state)
        if not console.is_terminal:
            steps_left = self._steps - result.step
            left = f"  {steps_left / pace:.0f} s left" if pace and steps_left else ""
            self._print(f"step {result.step:,}/{self._steps:,}  {state}{left}")

    def evaluation(self, step: int, split: str, metrics: ImageMetrics) -> None:
        self._print(f"step {step:,}: {split} PSNR {metrics.psnr:.2f} dB, SSIM {metrics.ssim:.4f}")

    def rolled_back(self, reason: str, step: int, lr_factor: float) -> None:
        self._first = None
        self._print(f"{reason}; back to step {step:,}, with learning rates times {lr_factor:g}", style="yellow")

    def should_stop(self) -> bool:
        return self._stop.is_set()

    def _print(self, line: str, style: str | None = None) -> None:
        with contextlib.suppress(OSError, SystemExit):  # rich exits if the output is not read
            console.print(line, style=style, soft_wrap=True)

    def _on_interrupt(self, number: int, frame: FrameType | None) -> None:
        if self._stop.is_set():
            raise KeyboardInterrupt
        self._stop.set()


def print_result(result: RunResult, data: Path, run: Path, elements: str) -> None:
    """Print the run's status, metrics and models, and the command that continues it; `elements` names what models are
    made of."""
    console.print(f"{result.status} at step {result.step:,}, {result.gaussians:,} {elements}, {result.seconds:.0f} s")
    for split, metrics in result.metrics.items():
        console.print(f"{split:>5}: PSNR {metrics.psnr:.2f} dB, SSIM {metrics.ssim:.4f}")
    console.print(f"model: {run / MODEL}", soft_wrap=True)
    if result.best is not None:
        best = f"{result.best.split} PSNR {result.best.psnr:.2f} dB at step {result.best.step:,}"
        console.print(f"best:  {run / BEST}, {best}", soft_wrap=True)
    if result.status != "finished":
        command = shlex.join(["msdgs-train", "fit", str(data), str(run), "--resume"])
        console.print(f"continue with: {command}", soft_wrap=True)

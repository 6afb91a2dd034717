"""What `to_onnx.py` does, and what it prints while it does."""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import onnx
from rich.console import Console
from rich.progress import Progress
from rich.table import Column, Table

from export.jobs.job import Candidate, Job, Unreachable
from export.jobs.report import COLUMNS, gain, report, rows, write_report
from export.jobs.sweep import Sweep
from export.jobs.write import Exported, write_scene
from export.measure.rendered_error import RenderedError
from export.plans.registry import parse
from export.pruning import RULES
from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.evaluation.metrics import MAX_PSNR
from msdgs_train.gaussians.model_file import load_model

if TYPE_CHECKING:
    from export.measure.images import Images

LEAST_ERROR = 10.0
"""dB. Under it a frame isn't one of the scene any more."""

WIDE = 180
"""Characters that all columns of the table take."""

TELLING = ("", "plan", "trimmed to", "SH", "moving", "ms", "MB", "worst frame")
"""Columns for narrower terminals."""


@dataclass(frozen=True)
class Settings:
    """What the command line says."""

    model: Path
    output: Path
    min_psnr: float  # dB on the worst frame
    plan: str | None  # None: the sweep chooses
    data: Path | None
    off: frozenset[str]  # rules of trimming
    tolerance: float
    times: int


def export(settings: Settings, console: Console) -> None:
    """Choose a candidate, prove it and write it. Raises errors that say what to do; old files stay until the end."""
    _check(settings)
    with (
        tempfile.TemporaryDirectory(prefix="msdgs-export-") as folder,
        Progress(console=console, transient=True) as progress,
    ):
        started = time.monotonic()

        def track(what: str, steps: int) -> Callable[[], object]:
            if steps and not console.is_terminal:  # a log shows no bars
                console.print(f"{time.monotonic() - started:5.0f} s  {what} …", markup=False)
            task = progress.add_task(what, total=steps)
            return lambda: progress.advance(task)

        photographs = _images(settings, track)
        rules = [rule for rule in RULES if rule not in settings.off]
        training = photographs.training if photographs else []
        job = Job(
            settings.model, Path(folder), min_psnr=settings.min_psnr, rules=rules, training=training, progress=track
        )
        contents = None
        if settings.plan is None:
            result = Sweep(job, settings.min_psnr, photographs).run()
            contents = report(job, result)
            chosen, error = result.points[result.chosen].candidate, result.points[result.chosen].error
        else:
            chosen, error = _planned(job, settings)
        exported = write_scene(
            settings.output,
            onnx.load(chosen.path),
            chosen.trimmed.moving,
            rendered=error.to_plain(),
            tolerance=settings.tolerance,
            times=settings.times,
            on_time=track("comparing poses with the model", settings.times),
        )
    if contents:
        _print_table(contents, console)
        console.print(gain(contents), markup=False)
        for path in write_report(contents, settings.output):
            console.print(f"wrote {path}", markup=False)
    _print_chosen(chosen, error, exported, console)


def _check(settings: Settings) -> None:
    error = settings.min_psnr
    if not (math.isfinite(error) and LEAST_ERROR <= error <= MAX_PSNR):
        raise InvalidInput("min_psnr", f"a PSNR in dB from {LEAST_ERROR:g} to {MAX_PSNR:g}; 50 is invisible", error)
    if not settings.tolerance >= 0:
        raise InvalidInput("tolerance", "0 or more", settings.tolerance)
    if settings.times < 2:
        raise InvalidInput("times", "2 or more", settings.times)
    if settings.plan is not None:
        parse(settings.plan)
    if not settings.output.parent.is_dir():
        raise InvalidInput("output", "in a folder that exists", str(settings.output))


def _images(settings: Settings, track: Callable[[str, int], Callable[[], object]]) -> Images | None:
    if settings.data is None:
        return None
    try:
        from export.measure.images import (
            Images,  # of the trainer's own readers, which the export alone doesn't need
        )
    except ModuleNotFoundError as error:
        raise InvalidInput("data", "left out, or pip install '.[train,export]'", f"no module {error.name}") from None
    info = load_model(settings.model).scene
    return Images(settings.data, info, lambda count: track("images", count))


def _planned(job: Job, settings: Settings) -> tuple[Candidate, RenderedError]:
    """The plan asked for, trimmed as far as the error allows beside the plan's own."""
    assert settings.plan is not None
    whole = job.candidate(settings.plan, None)
    best = job.error(whole)
    if best.psnr_worst < settings.min_psnr:
        reachable = f"at most {math.floor(10 * best.psnr_worst) / 10:.1f}, which the plan {settings.plan} reaches"
        raise Unreachable("min_psnr", f"{reachable} on its worst frame", settings.min_psnr)
    if job.rules:
        left = 10 ** (-settings.min_psnr / 10) - 10 ** (-best.psnr_worst / 10)
        for share in (1.0, 0.5, 0.25) if left > 0 else ():
            trimmed = job.candidate(settings.plan, -10 * math.log10(share * left))
            error = job.error(trimmed)
            if error.psnr_worst >= settings.min_psnr:
                return trimmed, error
    return whole, best


def _print_table(contents: dict, console: Console) -> None:
    """All columns where they fit, else those that say most; the report has them all."""
    names = list(COLUMNS) if console.width >= WIDE else [name for name in COLUMNS if name in TELLING]
    table = Table(*(Column(name, no_wrap=True) for name in names), box=None)
    usual = [row for row in rows(contents) if names == list(COLUMNS) or not row[COLUMNS.index("rasterizer")]]
    for row in usual:
        cells = [cell for name, cell in zip(COLUMNS, row, strict=True) if name in names]
        table.add_row(*cells, style="bold" if row[0] == "★" else None)
    console.print(table)


def _print_chosen(chosen: Candidate, error: RenderedError, exported: Exported, console: Console) -> None:
    for entry in exported.metadata.left_out:
        saved = f", {entry['bytes_saved'] / 1e3:,.0f} kB saved" if entry.get("bytes_saved") else ""
        frame = f", worst frame then {entry['worst_frame_db']:.1f} dB" if "worst_frame_db" in entry else ""
        console.print(f"left out: {entry['what']}: {entry['count']:,} of {entry['of']:,}{saved}{frame}", markup=False)
    if not exported.metadata.left_out:
        console.print("left out: nothing")
    measured = exported.measured_error
    console.print(
        f"worst of {error.frames} frames against the exact network in float64: {error.psnr_worst:.1f} dB, "
        f"mean {error.psnr_mean:.1f} dB, worst pixel {error.worst_pixel:.3f}\n"
        f"poses against the layers that are left, {measured['times']} times: means {measured['means']:.1e}, "
        f"quats {measured['quats']:.1e}, scales {measured['scales']:.1e}: passed"
    )
    if measured["unstable"]["count"]:
        console.print(
            f"{measured['unstable']['count']:,} Gaussians are left out of these errors: there the model's own float32 "
            f"differs from its float64. The worst is off by {measured['unstable']['error']:.1e}"
        )
    console.print(
        f"{exported.path}: plan {chosen.plan}, {exported.size / 1e6:.2f} MB, {exported.moving_count:,} moving and "
        f"{exported.static_count:,} static Gaussians, {len(exported.metadata.layers)} layers",
        markup=False,
    )

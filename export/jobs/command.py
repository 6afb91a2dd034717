"""The export of one model as `to_onnx.py` runs it, and its output in the terminal."""

from __future__ import annotations

import math
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import onnx
from rich.console import Console
from rich.table import Column, Table

from export.jobs.job import Candidate, ExportJob
from export.jobs.report import COLUMNS, gain, report, rows, write_report
from export.jobs.store import METADATA_BYTES, UNUSABLE, stored, within_bytes
from export.jobs.sweep import Sweep, as_stored, pruning_levels
from export.jobs.write import Exported, write_scene
from export.measure.rendered_error import RenderedError
from export.options import ExportOptions
from export.plans.registry import parse
from export.progress import Track, tracked
from export.pruning import RULES
from export.target import PLAN_PART, TargetNotReached, check_min_psnr, squared
from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.writing import scratch_folder
from msdgs_train.gaussians.model_file import load_model

if TYPE_CHECKING:
    from export.measure.images import HeldOutImages

WIDE = 180
"""Width of the terminal, in characters, from which the table has all columns."""

NARROW_COLUMNS = ("", "plan", "pruned to", "SH", "moving", "ms", "MB", "worst frame")
"""Columns in narrower terminals."""


def export(model: Path, options: ExportOptions, console: Console) -> None:
    """Choose a candidate, verify it and write it. An error leaves files that were there as they are."""
    _check(options)
    with scratch_folder() as folder, tracked(console) as track:
        images = _held_out_images(model, options.data, track)
        rules = [rule for rule in RULES if rule not in options.keep]
        result = None
        limits = {"min_psnr": options.min_psnr, "max_bytes": options.max_mb and round(1e6 * options.max_mb)}
        job = ExportJob(model, folder, **limits, rules=rules, packs=options.packs, images=images, progress=track)
        if options.chosen_plan is None:
            result = Sweep(job).run()
            chosen, error = result.points[result.chosen].candidate, result.points[result.chosen].error
        else:
            planned = _planned if job.max_bytes is None else _planned_within_bytes
            chosen, error = planned(job, options.chosen_plan)
        if options.packs and job.max_bytes is None:
            chosen, error = stored(job, chosen, error, job.min_psnr)
        exported = write_scene(
            options.scene_file,
            onnx.load(chosen.float32 or chosen.path),
            chosen.pruned.moving,
            packed=onnx.load(chosen.path) if chosen.float32 else None,
            rendered=error.to_plain(),
            tolerance=options.tolerance,
            times=options.times,
            on_time=track("comparing poses with the model", options.times),
        )
        contents = None
        if result:
            result.points[result.chosen] = as_stored(job, result.points[result.chosen], chosen, error)
            contents = report(job, result)
            contents["points"][result.chosen]["bytes"] = exported.size
    if contents:
        _print_table(contents, console)
        console.print(gain(contents), markup=False)
        for path in write_report(contents, options.scene_file):
            console.print(f"wrote {path}", markup=False)
    _print_chosen(chosen, error, exported, console)


def _check(options: ExportOptions) -> None:
    if options.min_psnr is not None:
        check_min_psnr(options.min_psnr)
    if options.max_mb is not None and not 0 < options.max_mb < math.inf:
        raise InvalidInput("max_mb", "a positive number of megabytes, 10⁶ bytes each", options.max_mb)
    if not options.tolerance >= 0:
        raise InvalidInput("tolerance", "0 or more", options.tolerance)
    if options.times < 2:
        raise InvalidInput("times", "2 or more", options.times)
    if options.chosen_plan is not None:
        parse(options.chosen_plan)


def _held_out_images(model: Path, data: Path | None, track: Track) -> HeldOutImages | None:
    if data is None:
        return None
    try:
        from export.measure.images import HeldOutImages  # needs the trainer's readers of datasets
    except ModuleNotFoundError as error:
        raise InvalidInput("data", "left out, or pip install '.[train,export]'", f"no module {error.name}") from None
    return HeldOutImages(data, load_model(model).scene, lambda count: track("images", count))


def _planned(job: ExportJob, plan: str) -> tuple[Candidate, RenderedError]:
    """A candidate of the plan that was asked for, pruned as far as a part of what its own error leaves allows."""
    whole = job.candidate(plan, None)
    best = job.error(whole)
    if best.psnr_worst < job.min_psnr:
        raise TargetNotReached.psnr(best.psnr_worst, f"the plan {plan} reaches", job.min_psnr)
    if job.rules:
        budget = (PLAN_PART if job.packs else 1.0) * (squared(job.min_psnr) - squared(best.psnr_worst))
        for fraction in (1.0, 0.5, 0.25) if budget > 0 else ():
            with suppress(*UNUSABLE):  # then less is removed
                pruned = job.candidate(plan, -10 * math.log10(fraction * budget))
                error = job.error(pruned)
                if squared(error.psnr_worst) <= squared(best.psnr_worst) + budget:
                    return pruned, error
    return whole, best


def _planned_within_bytes(job: ExportJob, plan: str) -> tuple[Candidate, RenderedError]:
    """Of all levels of pruning that fit: the one with the smallest error, or with the job's `required_psnr` the most
    pruned that has it."""
    assert job.max_bytes is not None
    whole, required = job.candidate(plan, None), job.required_psnr
    if required is None and whole.size + METADATA_BYTES <= job.max_bytes:
        return whole, job.error(whole)
    candidates = [whole]
    for level in pruning_levels(job) if job.rules else ():
        with suppress(*UNUSABLE):
            candidates.append(job.candidate(plan, level))
    different = {candidate.digest: candidate for candidate in candidates}.values()
    fitting = within_bytes(job, list(different), [])
    best, error = max(fitting, key=lambda each: each[1].psnr_worst)
    if required is None:
        return best, error
    if error.psnr_worst < required:
        raise TargetNotReached.psnr(error.psnr_worst, f"the plan {plan} reaches in so many bytes", required)
    return [each for each in fitting if each[1].psnr_worst >= required][-1]


def _print_table(contents: dict, console: Console) -> None:
    """Print all columns if they fit, else the most important ones; the report has all."""
    names = list(COLUMNS) if console.width >= WIDE else [name for name in COLUMNS if name in NARROW_COLUMNS]
    table = Table(*(Column(name, no_wrap=True) for name in names), box=None)
    for row in (dict(zip(COLUMNS, cells, strict=True)) for cells in rows(contents)):
        table.add_row(*(row[name] for name in names), style="bold" if row[""] == "★" else None)
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
        f"poses against the remaining layers, {measured['times']} times: means {measured['means']:.1e}, "
        f"quats {measured['quats']:.1e}, scales {measured['scales']:.1e}"
    )
    if measured["unstable"]["count"]:
        console.print(
            f"{measured['unstable']['count']:,} Gaussians, with poses that differ between the model's own float32 and "
            f"float64, are excluded from these errors. Their largest error is {measured['unstable']['error']:.1e}"
        )
    console.print(
        f"{exported.path}: plan {chosen.plan}, {exported.size / 1e6:.2f} MB, {exported.moving_count:,} moving and "
        f"{exported.static_count:,} static Gaussians, {len(exported.metadata.layers)} layers",
        markup=False,
    )

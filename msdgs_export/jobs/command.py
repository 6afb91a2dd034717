"""The export of one model as `msdgs-export` runs it, and its output in the terminal."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import onnx
from rich.console import Console
from rich.table import Column, Table

from msdgs_export.jobs.builder import CandidateBuilder
from msdgs_export.jobs.candidate import Measured
from msdgs_export.jobs.checkpoint import Checkpoint
from msdgs_export.jobs.packing import stored
from msdgs_export.jobs.planned import planned
from msdgs_export.jobs.points import as_stored
from msdgs_export.jobs.report import COLUMNS, gain, report, rows, write_report
from msdgs_export.jobs.ruler import Ruler
from msdgs_export.jobs.sweep import Sweep
from msdgs_export.jobs.write import Exported, write_scene
from msdgs_export.options import ExportOptions
from msdgs_export.progress import Track, tracked
from msdgs_export.pruning import RULES
from msdgs_export.target import Target, default_min_psnr
from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.writing import scratch_folder
from msdgs_train.gaussians.model_file import load_model

if TYPE_CHECKING:
    from msdgs_export.measure.images import HeldOutImages

WIDE = 180
"""Width of the terminal, in characters, from which the table has all columns."""

NARROW_COLUMNS = ("", "plan", "pruned to", "SH", "moving", "ms", "MB", "worst frame")
"""Columns in narrower terminals."""


def export(model: Path, options: ExportOptions, console: Console) -> None:
    """Choose a candidate, verify it and write it. An error leaves files that were there as they are.

    `options` are those that a trained model has, with valid values.
    """
    with scratch_folder() as folder, tracked(console) as track:
        images = _held_out_images(model, options.data, track)
        checkpoint = Checkpoint.load(model)
        ruler = Ruler(checkpoint, images, track)
        target = _target(options.min_psnr, options.max_mb, ruler, packs=options.packs)
        rules = [rule for rule in RULES if rule not in options.keep]
        builder = CandidateBuilder.of(checkpoint, ruler, target, folder, rules)
        result = contents = None
        if options.chosen_plan is None:
            result = Sweep(builder, ruler, target).run()
            chosen = result.points[result.chosen].measured
        else:
            chosen = planned(options.chosen_plan, builder, ruler, target)
        if target.packs and target.max_bytes is None:
            chosen = stored(chosen, ruler, target.min_psnr)
        file = chosen.candidate
        exported = write_scene(
            options.scene_file,
            onnx.load(file.float32 or file.path),
            file.pruned.moving,
            packed=onnx.load(file.path) if file.float32 else None,
            rendered=chosen.error.to_plain(),
            tolerance=options.tolerance,
            times=options.times,
            on_time=track("comparing poses with the model", options.times),
        )
        if result:
            result.points[result.chosen] = as_stored(result.points[result.chosen], chosen, ruler)
            contents = report(checkpoint, ruler, target, result)
            contents["points"][result.chosen]["bytes"] = exported.size
    if contents:
        _print_table(contents, console)
        console.print(gain(contents), markup=False)
        for path in write_report(contents, options.scene_file):
            console.print(f"wrote {path}", markup=False)
    _print_chosen(chosen, exported, console)


def _held_out_images(model: Path, data: Path | None, track: Track) -> HeldOutImages | None:
    if data is None:
        return None
    try:
        from msdgs_export.measure.images import HeldOutImages  # needs the trainer's readers of datasets
    except ModuleNotFoundError as error:
        raise InvalidInput(
            "data", "left out, or pip install 'msdgs[train,export]'", f"no module {error.name}"
        ) from None
    return HeldOutImages(data, load_model(model).scene, lambda count: track("images", count))


def _target(asked_psnr: float | None, max_mb: float | None, ruler: Ruler, *, packs: bool) -> Target:
    """What was asked for; a PSNR that wasn't is made from the error of the exact frames against held-out images."""
    min_psnr = default_min_psnr(ruler.exact_images_psnr) if asked_psnr is None else asked_psnr
    max_bytes = None if max_mb is None else round(1e6 * max_mb)
    return Target(min_psnr, max_bytes, bytes_only=max_bytes is not None and asked_psnr is None, packs=packs)


def _print_table(contents: dict, console: Console) -> None:
    """Print all columns if they fit, else the most important ones; the report has all."""
    names = list(COLUMNS) if console.width >= WIDE else [name for name in COLUMNS if name in NARROW_COLUMNS]
    table = Table(*(Column(name, no_wrap=True) for name in names), box=None)
    for row in (dict(zip(COLUMNS, cells, strict=True)) for cells in rows(contents)):
        table.add_row(*(row[name] for name in names), style="bold" if row[""] == "★" else None)
    console.print(table)


def _print_chosen(chosen: Measured, exported: Exported, console: Console) -> None:
    for entry in exported.metadata.left_out:
        saved = f", {entry['bytes_saved'] / 1e3:,.0f} kB saved" if entry.get("bytes_saved") else ""
        frame = f", worst frame then {entry['worst_frame_db']:.1f} dB" if "worst_frame_db" in entry else ""
        console.print(f"left out: {entry['what']}: {entry['count']:,} of {entry['of']:,}{saved}{frame}", markup=False)
    if not exported.metadata.left_out:
        console.print("left out: nothing")
    measured, error = exported.measured_error, chosen.error
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
        f"{exported.path}: plan {chosen.candidate.plan}, {exported.size / 1e6:.2f} MB, {exported.moving_count:,} "
        f"moving and {exported.static_count:,} static Gaussians, {len(exported.metadata.layers)} layers",
        markup=False,
    )

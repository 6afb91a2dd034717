"""A stability report as text in the terminal and as JSON."""

import json
from pathlib import Path

from rich.console import Console
from rich.table import Column, Table

from msdgs_export.precision.assess import assess
from msdgs_export.precision.report import Float32Gap, StabilityReport, WorstGaussians
from msdgs_export.progress import tracked
from msdgs_serve.writing import write_text
from msdgs_train.evaluation.metrics import MAX_PSNR
from msdgs_train.gaussians.model_file import load_model

QUANTILES = ("median", "99.9 %", "largest")


def assess_and_show(
    model: Path, times: int, min_psnr: float, json_file: Path | None, messages: Console
) -> StabilityReport:
    """Assess a model.pt, print the report, and write it as JSON if a file is given."""
    loaded = load_model(model)
    with tracked(messages) as track:
        report = assess(loaded.model, loaded.scene, min_psnr=min_psnr, times=times, track=track)
    print_report(report, Console(soft_wrap=True, highlight=False))
    if json_file is not None:
        write_text(json_file, json.dumps(report.to_plain(), indent=2, allow_nan=False) + "\n")
    return report


def print_report(report: StabilityReport, console: Console) -> None:
    """Print growth through the layers, the errors, the worst Gaussians and the verdict."""
    console.print(f"{report.gaussians:,} Gaussians, {len(report.layers)} layers, {report.times} times")
    if report.float32 is not None:
        growth = Table("growth of a small displacement, after layer", *QUANTILES, box=None)
        for k, (kind, row) in enumerate(zip(report.layers, report.layer_growth, strict=True), start=1):
            growth.add_row(f"{k} ({kind})", *(f"× {value:,.1f}" for value in row))
        console.print(growth, _error_table(report.float32, report), sep="\n")
        console.print(
            "median to largest: relative error of a pose. dB, value: the worst frame, and its worst pixel. Without "
            f"worst: with the worst 0.1 % of the Gaussians in float64. Red: under {report.min_psnr:g} dB",
            style="dim",
        )
    if report.worst is not None:
        console.print(_worst_sentence(report.worst), markup=False)
    for limit, count in report.limits.items():
        console.print(f"{limit}: {count:,} of the Gaussians", markup=False)
    console.print(report.verdict, style="bold green" if report.stable else "bold red", markup=False)


def _error_table(gap: Float32Gap, report: StabilityReport) -> Table:
    columns = (*QUANTILES, "pixels", "dB", "without worst", "value")
    table = Table(Column("against float64", no_wrap=True), *columns, box=None)
    errors = (f"{value:.1e}" for value in (gap.median, gap.near_worst, gap.worst, gap.pixels))
    frames = (_decibels(gap.psnr), _decibels(gap.psnr_without_worst), f"{gap.worst_pixel:.1e}")
    table.add_row("float32", *errors, *frames, style="" if gap.psnr >= report.min_psnr else "red")
    table.add_row("predicted", *[""] * 4, _decibels(report.predicted_psnr))
    return table


def _worst_sentence(worst: WorstGaussians) -> str:
    center = ", ".join(f"{value:.3g}" for value in worst.center)
    ids = ", ".join(map(str, worst.ids[:8])) + (" …" if len(worst.ids) > 8 else "")
    return (
        f"the {len(worst.ids):,} Gaussians with the largest errors in float32, at t = {worst.t:.4g}: at ({center}), "
        f"{worst.spread:.0%} of the scene's half diagonal wide, {worst.outside_bounds:,} outside of its bounds; moved "
        f"by {worst.moved:.1%} of it; error at most {worst.pixels:.2g} pixels. The frame with and without them: "
        f"{_decibels(worst.drawn_psnr)} dB. Ids {ids}"
    )


def _decibels(psnr: float) -> str:
    return f"{psnr:.1f}" if psnr < MAX_PSNR else f"≥ {MAX_PSNR:g}"

"""A stability report as text in the terminal, as JSON and as a figure."""

import json
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Column, Table

from export.measure.amplification import UNIT_ROUNDOFF
from export.precision.assess import assess
from export.precision.formats import FORMATS
from export.precision.report import StabilityReport, WorstGaussians
from export.progress import tracked
from msdgs_serve.writing import replacing, write_text
from msdgs_train.evaluation.metrics import MAX_PSNR
from msdgs_train.gaussians.model_file import load_model

MAX_DRAWN = 1e30
QUANTILES = ("median", "99.9 %", "largest")


def assess_and_show(
    model: Path, times: int, min_psnr: float, json_file: Path | None, plot: Path | None, messages: Console
) -> StabilityReport:
    """Assess a model.pt in all formats, print the report, and write the files that are asked for."""
    loaded = load_model(model)
    with tracked(messages) as track:
        report = assess(loaded.model, loaded.scene, min_psnr=min_psnr, times=times, formats=FORMATS, track=track)
    print_report(report, Console(soft_wrap=True, highlight=False))
    if json_file is not None:
        write_text(json_file, json.dumps(report.to_plain(), indent=2, allow_nan=False) + "\n")
    if plot is not None:
        draw(report, plot)
    return report


def print_report(report: StabilityReport, console: Console) -> None:
    """Print growth through the layers, the formats, the worst Gaussians and the verdict."""
    console.print(f"{report.gaussians:,} Gaussians, {len(report.layers)} layers, {report.times} times")
    if report.layer_growth:
        growth = Table("growth of a small displacement, after layer", *QUANTILES, box=None)
        for k, (kind, row) in enumerate(zip(report.layers, report.layer_growth, strict=True), start=1):
            growth.add_row(f"{k} ({kind})", *(f"× {value:,.1f}" for value in row))
        console.print(growth, _format_table(report), sep="\n")
        for gap in report.formats:
            console.print(f"{gap.name}: {gap.meaning}", style="dim", markup=False)
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


def _format_table(report: StabilityReport) -> Table:
    columns = (*QUANTILES, "pixels", "dB", "without worst", "value")
    table = Table(Column("against float64", no_wrap=True), *columns, box=None)
    for gap in report.formats:
        errors = (f"{value:.1e}" for value in (gap.median, gap.near_worst, gap.worst, gap.pixels))
        frames = (_decibels(gap.psnr), _decibels(gap.psnr_without_worst), f"{gap.worst_pixel:.1e}")
        table.add_row(gap.name, *errors, *frames, style="" if gap.psnr >= report.min_psnr else "red")
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


def draw(report: StabilityReport, path: Path) -> None:
    """Write a PNG: growth of a displacement by layer, a histogram of its amplification, and the errors over it."""
    figure = Figure(figsize=(15, 4.6), layout="constrained")
    layers, histogram, errors = figure.subplots(1, 3)
    samples, steps = report.samples, np.arange(len(report.layer_growth) + 1)
    growth = np.nan_to_num([[1.0] * 3, *report.layer_growth], nan=MAX_DRAWN, posinf=MAX_DRAWN)
    for label, values in zip(QUANTILES, growth.T, strict=True):
        layers.semilogy(steps, values, marker="o", label=label)
    layers.set(xlabel="after layer", ylabel="growth of a small displacement", xticks=steps[:: max(1, len(steps) // 12)])
    layers.legend()
    amplification = np.clip(samples.amplification, 1, MAX_DRAWN)
    top = max(float(amplification.max(initial=1)), 10.0)
    histogram.hist(amplification, bins=np.geomspace(1, top, 40).tolist(), log=True)
    histogram.set(xscale="log", xlabel="amplification, largest product of Jacobians", ylabel="Gaussians × times")
    shown = np.isfinite(samples.distance) & (samples.distance > 0) & (amplification < MAX_DRAWN)
    errors.loglog(amplification[shown], samples.distance[shown], ".", markersize=2, alpha=0.3, label="measured")
    shown &= np.isfinite(samples.predicted) & (samples.predicted < MAX_DRAWN)
    errors.loglog(amplification[shown], samples.predicted[shown], ".", markersize=2, alpha=0.15, label="predicted")
    ends = np.array([1.0, top])
    errors.loglog(ends, UNIT_ROUNDOFF * ends, color="black", label="amplification × 2⁻²⁴")
    errors.set(xlabel="amplification", ylabel="float32 against float64, scene units")
    errors.legend(markerscale=3)
    for axis in (layers, histogram, errors):
        axis.grid(alpha=0.3)
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=110, format="png")

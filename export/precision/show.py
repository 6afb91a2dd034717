"""A stability report as text in the terminal, and as a figure."""

import json
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Column, Table

from export.measure.amplification import UNIT_ROUNDOFF
from export.precision.report import StabilityReport, WorstGaussians
from msdgs_train.datasets.common.files import replacing, write_text
from msdgs_train.evaluation.metrics import MAX_PSNR

LARGEST_DRAWN = 1e30


def print_report(report: StabilityReport, console: Console) -> None:
    """Growth through the layers, the formats, the worst Gaussians, the verdict."""
    console.print(f"{report.gaussians:,} Gaussians, {len(report.layers)} layers, {report.times} times")
    if report.layer_growth:
        growth = Table("a small displacement, after layer", "median", "99.9 %", "largest", box=None)
        for k, (kind, row) in enumerate(zip(report.layers, report.layer_growth, strict=True), start=1):
            growth.add_row(f"{k} ({kind})", *(f"× {value:,.1f}" for value in row))
        console.print(growth)
        console.print(_format_table(report))
        for gap in report.formats:
            console.print(f"{gap.name}: {gap.meaning}", style="dim", markup=False)
        console.print(
            "median to largest: relative error of a pose. dB, value: the worst frame, and its worst pixel. Without "
            f"worst: with the worst 0.1 % of the Gaussians in float64. Red: under {report.min_psnr:g} dB",
            style="dim",
        )
    if report.worst is not None:
        console.print(_worst_sentence(report.worst), markup=False)
    for what, count in report.limits.items():
        console.print(f"{what}: {count:,} of the Gaussians", markup=False)
    console.print(report.verdict, style="bold green" if report.stable else "bold red", markup=False)


def _format_table(report: StabilityReport) -> Table:
    columns = ("median", "99.9 %", "largest", "pixels", "dB", "without worst", "value")
    table = Table(Column("against float64", no_wrap=True), *columns, box=None)
    for gap in report.formats:
        errors = (f"{value:.1e}" for value in (gap.median, gap.near_worst, gap.worst, gap.pixels))
        frames = (decibels(gap.psnr), decibels(gap.psnr_without_worst), f"{gap.worst_pixel:.1e}")
        table.add_row(gap.name, *errors, *frames, style="" if gap.psnr >= report.min_psnr else "red")
    table.add_row("predicted", *[""] * 4, decibels(report.predicted_psnr))
    return table


def _worst_sentence(worst: WorstGaussians) -> str:
    center = ", ".join(f"{value:.3g}" for value in worst.center)
    return (
        f"the {len(worst.ids):,} Gaussians with the largest errors in float32, at t = {worst.t:.4g}: at ({center}), "
        f"{worst.spread:.0%} of the scene's half diagonal wide, {worst.outside_bounds:,} outside of its bounds; moved "
        f"by {worst.moved:.1%} of it; off by at most {worst.pixels:.2g} pixels. The frame with against without them: "
        f"{decibels(worst.drawn_psnr)} dB. Ids {', '.join(map(str, worst.ids[:8]))}{' …' if len(worst.ids) > 8 else ''}"
    )


def decibels(psnr: float) -> str:
    """A PSNR, which is cut at 100 dB."""
    return f"{psnr:.1f}" if psnr < MAX_PSNR else f"≥ {MAX_PSNR:g}"


def write_json(report: StabilityReport, path: Path) -> None:
    """Atomically; infinities are null."""
    write_text(path, json.dumps(report.to_plain(), indent=2, allow_nan=False) + "\n")


def draw(report: StabilityReport, path: Path) -> None:
    """A PNG: growth of a displacement from layer to layer, a histogram of its amplification, and the error over it."""
    from matplotlib.figure import Figure  # slow to import

    figure = Figure(figsize=(15, 4.6), layout="constrained")
    layers, histogram, errors = figure.subplots(1, 3)
    samples, steps = report.samples, np.arange(len(report.layer_growth) + 1)
    growth = np.nan_to_num([[1.0] * 3, *report.layer_growth], nan=LARGEST_DRAWN, posinf=LARGEST_DRAWN)
    for label, values in zip(("median", "99.9 %", "largest"), growth.T, strict=True):
        layers.semilogy(steps, values, marker="o", label=label)
    layers.set(xlabel="after layer", ylabel="growth of a small displacement", xticks=steps[:: max(1, len(steps) // 12)])
    layers.legend()
    amplification = np.clip(samples.amplification, 1, LARGEST_DRAWN)
    top = max(float(amplification.max(initial=1)), 10.0)
    histogram.hist(amplification, bins=np.geomspace(1, top, 40).tolist(), log=True)
    histogram.set(xscale="log", xlabel="amplification, largest product of Jacobians", ylabel="Gaussians × times")
    shown = np.isfinite(samples.distance) & (samples.distance > 0) & (amplification < LARGEST_DRAWN)
    errors.loglog(amplification[shown], samples.distance[shown], ".", markersize=2, alpha=0.3, label="measured")
    shown &= np.isfinite(samples.predicted) & (samples.predicted < LARGEST_DRAWN)
    errors.loglog(amplification[shown], samples.predicted[shown], ".", markersize=2, alpha=0.15, label="predicted")
    ends = np.array([1.0, top])
    errors.loglog(ends, UNIT_ROUNDOFF * ends, color="black", label="amplification × 2⁻²⁴")
    errors.set(xlabel="amplification", ylabel="float32 against float64, scene units")
    for handle in errors.legend().legend_handles[:2]:
        handle.set(alpha=1, markersize=6)  # type: ignore[union-attr]
    for axis in (layers, histogram, errors):
        axis.grid(alpha=0.3)
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=110, format="png")

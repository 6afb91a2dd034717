"""A stability report for people: a table in the terminal, JSON, and a figure."""

import json
import math
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Column, Table

from export.measure.amplification import UNIT_ROUNDOFF
from export.precision.report import StabilityReport
from msdgs_train.engine.files import replacing, write_text
from msdgs_train.evaluation.metrics import MAX_PSNR


def print_report(report: StabilityReport, console: Console) -> None:
    """Growth through the layers, the formats, the worst Gaussians, the verdict."""
    console.print(f"{report.gaussians:,} Gaussians, {len(report.layers)} layers, {report.times} times")
    if report.layer_growth:
        console.print(_growth_table(report))
        console.print(_format_table(report))
        for gap in report.formats:
            console.print(f"{gap.name}: {gap.meaning}", style="dim", markup=False)
        console.print(
            "median to largest: relative error of a pose. dB, value: the worst frame, and its worst pixel. "
            f"Healed: with the worst 0.1 % in float64. Red: under {report.min_psnr:g} dB",
            style="dim",
        )
    if report.worst is not None:
        _print_worst(report, console)
    for what, count in report.limits.items():
        console.print(f"{what}: {count:,} of the Gaussians", markup=False)
    console.print(report.verdict, style="bold green" if report.steady else "bold red", markup=False)


def _growth_table(report: StabilityReport) -> Table:
    table = Table("a small displacement, after layer", "median", "99.9 %", "largest", box=None, title_justify="left")
    for k, (kind, row) in enumerate(zip(report.layers, report.layer_growth, strict=True), start=1):
        table.add_row(f"{k} ({kind})", *(f"× {value:,.1f}" for value in row))
    return table


def _format_table(report: StabilityReport) -> Table:
    columns = ("median", "99.9 %", "largest", "pixels", "dB", "outliers_replaced", "value")
    table = Table(Column("against float64", no_wrap=True), *columns, box=None)
    for gap in report.formats:
        table.add_row(
            gap.name,
            *(f"{value:.1e}" for value in (gap.median, gap.near_worst, gap.worst)),
            f"{gap.pixels:.1e}",
            decibels(gap.psnr, ""),
            decibels(gap.psnr_without_worst, ""),
            f"{gap.worst_pixel:.1e}",
            style="" if gap.psnr >= report.min_psnr else "red",
        )
    table.add_row("predicted", *[""] * 4, decibels(report.predicted_psnr, ""), "", "")
    return table


def _print_worst(report: StabilityReport, console: Console) -> None:
    worst = report.worst
    assert worst is not None
    place = ", ".join(f"{value:.3g}" for value in worst.center)
    console.print(
        f"the {len(worst.ids):,} Gaussians that float32 gets most wrong, at t = {worst.t:.4g}: around ({place}), "
        f"{worst.spread:.0%} of the scene's half diagonal wide, {worst.outside_bounds:,} outside of its bounds; moved "
        f"by {worst.moved:.1%} of it; off by at most {worst.pixels:.2g} pixels. The image with against without them: "
        f"{decibels(worst.drawn_psnr)}. Ids {', '.join(map(str, worst.ids[:8]))}{' …' if len(worst.ids) > 8 else ''}",
        markup=False,
    )


def decibels(psnr: float, unit: str = " dB") -> str:
    """PSNR is cut at 100."""
    return (f"{psnr:.1f}" if psnr < MAX_PSNR else f"≥ {MAX_PSNR:g}") + unit


def write_json(report: StabilityReport, path: Path) -> None:
    """Atomically; infinities are null."""
    write_text(path, json.dumps(report.to_plain(), indent=2, allow_nan=False) + "\n")


def draw(report: StabilityReport, path: Path) -> None:
    """A PNG: how a displacement grows from layer to layer, how often it is amplified, and the gap it leads to."""
    from matplotlib.figure import Figure  # a second to import, and only wanted here

    figure = Figure(figsize=(15, 4.6), layout="constrained")
    layers, histogram, gaps = figure.subplots(1, 3)
    samples = report.samples
    steps = np.arange(len(report.layer_growth) + 1)
    for i, label in enumerate(("median", "99.9 %", "largest")):
        layers.semilogy(steps, [1.0, *(_drawable(row[i]) for row in report.layer_growth)], marker="o", label=label)
    layers.set(xlabel="after layer", ylabel="growth of a small displacement", xticks=steps[:: max(1, len(steps) // 12)])
    layers.legend()
    amplification = np.clip(samples.amplification, 1, 1e30)
    top = max(float(amplification.max(initial=1)), 10.0)
    histogram.hist(amplification, bins=np.geomspace(1, top, 40).tolist(), log=True)
    histogram.set(xscale="log", xlabel="amplification, largest product of Jacobians", ylabel="Gaussians × times")
    shown = np.isfinite(samples.distance) & (samples.distance > 0) & (amplification < 1e30)
    gaps.loglog(amplification[shown], samples.distance[shown], ".", markersize=2, alpha=0.3, label="measured")
    predicted = shown & np.isfinite(samples.predicted) & (samples.predicted < 1e30)
    gaps.loglog(
        amplification[predicted], samples.predicted[predicted], ".", markersize=2, alpha=0.15, label="predicted"
    )
    ends = np.array([1.0, top])
    gaps.loglog(ends, UNIT_ROUNDOFF * ends, color="black", label="amplification × 2⁻²⁴")
    gaps.set(xlabel="amplification", ylabel="float32 against float64, scene units")
    legend = gaps.legend()
    for handle in legend.legend_handles[:2]:
        handle.set(alpha=1, markersize=6)  # type: ignore[union-attr]
    for axis in (layers, histogram, gaps):
        axis.grid(alpha=0.3)
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=110, format="png")


def _drawable(value: float) -> float:
    return value if math.isfinite(value) else 1e30

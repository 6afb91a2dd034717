"""The work-precision diagram: milliseconds per frame on the x axis, error of the worst frame on the y axis."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FixedFormatter, FixedLocator, NullFormatter, NullLocator

from export.jobs.sweep import DEFAULT_RASTERIZER
from export.plans.registry import PLANS

DB_STEP = 10
MAX_DB = 100.0
LABEL_SIZE = np.array([250, 15])
"""Pixels reserved for a label."""

OTHER = "#9498a0"


def draw(contents: dict[str, Any], path: Path) -> None:
    """Write the diagram of a report as PNG."""
    figure = Figure(figsize=(10, 6.5), layout="constrained")
    axes = figure.subplots()
    points, budget = contents["points"], contents["min_psnr"]
    axes.set_xscale("log")
    axes.set_yscale("log")
    _front_line(axes, points)
    for kind in dict.fromkeys(_kind(point) for point in points):
        group = [point for point in points if _kind(point) == kind]
        usual = [point for point in group if point["rasterizer"] == DEFAULT_RASTERIZER]
        axes.scatter(*_places(usual), s=55, color=PLANS[kind].color, label=f"plan {kind}", zorder=3)
    others = [point for point in points if point["rasterizer"] != DEFAULT_RASTERIZER]
    if others:
        axes.scatter(*_places(others), s=55, marker="x", color=OTHER, label="other rasterizer options", zorder=3)
    chosen = [point for point in points if point["chosen"]]
    axes.scatter(*_places(chosen), s=420, marker="*", facecolors="gold", edgecolors="black", label="chosen", zorder=4)
    axes.axhline(_rms(budget), color="black", linewidth=1, linestyle="--")
    axes.text(
        0.995, _rms(budget), f"allowed: {budget:g} dB ", transform=axes.get_yaxis_transform(), va="bottom", ha="right"
    )
    _axes(axes, points, contents)
    axes.legend(loc="upper right", framealpha=0.95)
    figure.draw_without_rendering()  # fixes the positions of labels
    _label(axes, points)
    figure.savefig(path, dpi=110, format="png")


def _front_line(axes: Any, points: list[dict[str, Any]]) -> None:
    ahead = sorted((p for p in points if p["front"]), key=lambda p: p["milliseconds"]["total"]["min"])
    axes.plot(*_places(ahead), drawstyle="steps-post", color="black", linewidth=1.5, zorder=2, label="Pareto front")


def _label(axes: Any, points: list[dict[str, Any]]) -> None:
    """Label the points on the front and those that aren't pruned, the chosen one first, without overlaps."""
    taken: list[np.ndarray] = []
    named = [point for point in points if point["front"] or point["pruning_db"] is None]
    for point in sorted(named, key=lambda point: not point["chosen"]):
        x, y = _places([point])
        place = axes.transData.transform((x[0], y[0]))
        if all((np.abs(place - other) > LABEL_SIZE).any() for other in taken):
            axes.annotate(_text(point), (x[0], y[0]), xytext=(9, -11), textcoords="offset points", fontsize=8, zorder=5)
            taken.append(place)


def _text(point: dict[str, Any]) -> str:
    pruned = "unpruned" if point["pruning_db"] is None else f"pruned to {point['pruning_db']:g}"
    return f"{point['plan']}, {pruned}, SH {point['sh_degree']}"


def _axes(axes: Any, points: list[dict[str, Any]], contents: dict[str, Any]) -> None:
    decibels = [point["error"]["psnr_worst"] for point in points]
    ticks = np.arange(DB_STEP * np.floor(min(decibels) / DB_STEP), min(max(decibels), MAX_DB) + DB_STEP, DB_STEP)
    axes.yaxis.set_major_locator(FixedLocator([_rms(db) for db in ticks]))
    axes.yaxis.set_major_formatter(FixedFormatter([f"{db:.0f} dB\n{100 * _rms(db):.2g} %" for db in ticks]))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.set_ylabel("error of the worst frame against the exact one:\nPSNR and RMSE")
    times = [point["milliseconds"]["total"]["min"] for point in points]
    low, high = min(times) / 1.15, max(times) * 1.5
    places = [base * 10.0**power for power in range(-3, 6) for base in (1, 1.5, 2, 3, 4, 5, 7)]
    places = [place for place in places if low <= place <= high]
    axes.set_xlim(low, high)
    axes.xaxis.set_major_locator(FixedLocator(places))
    axes.xaxis.set_major_formatter(FixedFormatter([f"{place:g}" for place in places]))
    axes.xaxis.set_minor_formatter(NullFormatter())
    machine = contents["machine"]
    axes.set_xlabel(
        f"milliseconds per frame, deformation and drawing ({machine['processor']}, {machine['threads']} threads)"
    )
    axes.set_title("Each point is one way to store this scene: left is faster, down is more exact.")
    axes.grid(alpha=0.3, which="major")


def _kind(point: dict[str, Any]) -> str:
    return point["plan"].split(":")[0]


def _places(points: list[dict[str, Any]]) -> tuple[list[float], list[float]]:
    x = [point["milliseconds"]["total"]["min"] for point in points]
    return x, [_rms(point["error"]["psnr_worst"]) for point in points]


def _rms(db: float) -> float:
    """RMSE of a PSNR, values in [0, 1]."""
    return 10 ** (-db / 20)

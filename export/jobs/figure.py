"""The work-precision diagram: the error of the worst frame against milliseconds per frame, and against megabytes."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

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


class _Panel(NamedTuple):
    """One of the diagrams side by side."""

    axes: Any
    cost: Callable[[dict[str, Any]], float]  # of a point, on the x axis

    def places(self, points: list[dict[str, Any]]) -> tuple[list[float], list[float]]:
        return [self.cost(point) for point in points], [_rms(point["error"]["psnr_worst"]) for point in points]


def draw(contents: dict[str, Any], path: Path) -> None:
    """Write the diagram of a report as PNG."""
    figure = Figure(figsize=(16, 6.5), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    panels = _Panel(left, lambda p: p["milliseconds"]["total"]["min"]), _Panel(right, lambda p: p["bytes"] / 1e6)
    for panel in panels:
        _draw_points(panel, contents["points"])
        _draw_limit(panel.axes, contents["min_psnr"])
    machine = contents["machine"]
    left.set_xlabel(
        f"milliseconds per frame, deformation and drawing ({machine['processor']}, {machine['threads']} threads)"
    )
    right.set_xlabel("megabytes (10⁶ bytes); ○: in float32, before packing")
    left.set_ylabel("error of the worst frame against the exact one:\nPSNR and RMSE")
    figure.suptitle("Each point is one way to store this scene: left is faster or smaller, down is more exact.")
    if contents["max_bytes"] is not None:
        right.axvline(contents["max_bytes"] / 1e6, color="black", linewidth=1, linestyle="--")
    left.legend(loc="upper right", framealpha=0.95)
    figure.draw_without_rendering()  # fixes the positions of labels
    for panel in panels:
        _label(panel, contents["points"])
    figure.savefig(path, dpi=110, format="png")


def _draw_points(panel: _Panel, points: list[dict[str, Any]]) -> None:
    axes = panel.axes
    axes.set_xscale("log")
    axes.set_yscale("log")
    for kind in dict.fromkeys(_kind(point) for point in points):
        group = [point for point in points if _kind(point) == kind and point["rasterizer"] == DEFAULT_RASTERIZER]
        color = PLANS[kind].color
        faces = [color if point["packed"] else "none" for point in group]
        axes.scatter(*panel.places(group), s=55, facecolors=faces, edgecolors=color, zorder=3)
        axes.scatter([], [], s=55, color=color, label=f"plan {kind}")
    others = [point for point in points if point["rasterizer"] != DEFAULT_RASTERIZER]
    if others:
        axes.scatter(*panel.places(others), s=55, marker="x", color=OTHER, label="other rasterizer options", zorder=3)
    ahead = [point for point in points if point["front"]]
    axes.scatter(*panel.places(ahead), s=130, marker="D", facecolors="none", edgecolors="black", label="Pareto front")
    chosen = panel.places([point for point in points if point["chosen"]])
    axes.scatter(*chosen, s=420, marker="*", facecolors="gold", edgecolors="black", label="chosen", zorder=4)
    _set_ticks(panel, points)


def _draw_limit(axes: Any, min_psnr: float | None) -> None:
    if min_psnr is not None:
        y, text = _rms(min_psnr), f"allowed: {min_psnr:g} dB "
        axes.axhline(y, color="black", linewidth=1, linestyle="--")
        axes.text(0.995, y, text, transform=axes.get_yaxis_transform(), va="bottom", ha="right")


def _label(panel: _Panel, points: list[dict[str, Any]]) -> None:
    """Label the points on the front and those that aren't pruned, the chosen one first, without overlaps."""
    axes, taken = panel.axes, list[np.ndarray]()
    named = [point for point in points if point["front"] or point["pruning_db"] is None]
    for point in sorted(named, key=lambda point: not point["chosen"]):
        x, y = panel.places([point])
        place = axes.transData.transform((x[0], y[0]))
        if all((np.abs(place - other) > LABEL_SIZE).any() for other in taken):
            axes.annotate(_text(point), (x[0], y[0]), xytext=(9, -11), textcoords="offset points", fontsize=8, zorder=5)
            taken.append(place)


def _text(point: dict[str, Any]) -> str:
    pruned = "unpruned" if point["pruning_db"] is None else f"pruned to {point['pruning_db']:g}"
    return f"{point['plan']}, {pruned}, SH {point['sh_degree']}"


def _set_ticks(panel: _Panel, points: list[dict[str, Any]]) -> None:
    axes = panel.axes
    decibels = [point["error"]["psnr_worst"] for point in points]
    ticks = np.arange(DB_STEP * np.floor(min(decibels) / DB_STEP), min(max(decibels), MAX_DB) + DB_STEP, DB_STEP)
    axes.yaxis.set_major_locator(FixedLocator([_rms(db) for db in ticks]))
    axes.yaxis.set_major_formatter(FixedFormatter([f"{db:.0f} dB\n{100 * _rms(db):.2g} %" for db in ticks]))
    axes.yaxis.set_minor_locator(NullLocator())
    costs = [panel.cost(point) for point in points]
    low, high = min(costs) / 1.15, max(costs) * 1.5
    places = [base * 10.0**power for power in range(-3, 6) for base in (1, 1.5, 2, 3, 4, 5, 7)]
    places = [place for place in places if low <= place <= high]
    axes.set_xlim(low, high)
    axes.xaxis.set_major_locator(FixedLocator(places))
    axes.xaxis.set_major_formatter(FixedFormatter([f"{place:g}" for place in places]))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.grid(alpha=0.3, which="major")


def _kind(point: dict[str, Any]) -> str:
    return point["plan"].split(":")[0]


def _rms(db: float) -> float:
    """RMSE of a PSNR, values in [0, 1]."""
    return 10 ** (-db / 20)

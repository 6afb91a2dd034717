"""The work-precision diagram: the error of the worst frame against milliseconds per frame, and against megabytes."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FixedFormatter, FixedLocator, NullFormatter, NullLocator

from msdgs_export.plans.registry import PLANS

DB_STEP = 10
MAX_DB = 100.0
LABEL_SIZE = np.array([250, 15])
"""Pixels reserved for a label."""

LABELED_LEFT = 0.7
"""Fraction of the width from which a point's label is to its left, so that it stays inside."""

TICKS, MAX_TICKS = ((1, 1.5, 2, 3, 4, 5, 7), (1, 2, 5), (1,)), 14
"""Ticks per decade, the first of these of which no more fit between the points."""


Cost = Callable[[dict[str, Any]], float]
COSTS: tuple[Cost, Cost] = (lambda p: p["milliseconds"]["total"]["min"], lambda p: p["bytes"] / 1e6)
"""The x axes of the panels side by side."""


def draw(contents: dict[str, Any], path: Path) -> None:
    """Write the diagram of a report as PNG."""
    figure = Figure(figsize=(16, 6.5), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    points, budget, limit = (contents[name] for name in ("points", "min_psnr", "max_bytes"))
    for axes, cost in zip((left, right), COSTS, strict=True):
        _draw_points(axes, cost, points)
        _set_ticks(axes, cost, points)
        if budget is not None:
            axes.axhline(_rms(budget), color="black", linewidth=1, linestyle="--")
            text, place = f"allowed: {budget:g} dB ", axes.get_yaxis_transform()
            axes.text(0.995, _rms(budget), text, transform=place, va="bottom", ha="right")
    if limit is not None:
        right.axvline(limit / 1e6, color="black", linewidth=1, linestyle="--")
    machine = f"{contents['machine']['processor']}, {contents['machine']['threads']} threads"
    left.set_xlabel(f"milliseconds per frame, deformation and drawing ({machine})")
    right.set_xlabel("megabytes (10⁶ bytes); hollow: in float32")
    left.set_ylabel("error of the worst frame against the exact one:\nPSNR and RMSE")
    figure.suptitle("Each point is one way to store this scene: left is faster or smaller, down is more exact.")
    left.legend(loc="upper right", framealpha=0.95)
    figure.draw_without_rendering()  # fixes the positions of labels
    for axes, cost in zip((left, right), COSTS, strict=True):
        _label(axes, cost, points)
    figure.savefig(path, dpi=110, format="png")


def _draw_points(axes: Any, cost: Cost, points: list[dict[str, Any]]) -> None:
    def scatter(group: list[dict[str, Any]], label: str, **style: Any) -> None:
        errors = [_rms(point["error"]["psnr_worst"]) for point in group]
        axes.scatter([cost(point) for point in group], errors, label=label, **style)

    for kind in dict.fromkeys(_kind(point) for point in points):
        group, color = [point for point in points if _kind(point) == kind], PLANS[kind].color
        faces = [color if point["packed"] else "white" for point in group]
        scatter(group, f"plan {kind}", s=55, facecolors=faces, edgecolors=color, linewidths=2, zorder=3)
    ahead = [point for point in points if point["front"]]
    scatter(ahead, "Pareto front", s=150, marker="D", facecolors="none", edgecolors="black", zorder=2)
    chosen = [point for point in points if point["chosen"]]
    scatter(chosen, "chosen", s=420, marker="*", facecolors="gold", edgecolors="black", zorder=4)


def _label(axes: Any, cost: Cost, points: list[dict[str, Any]]) -> None:
    """Label the points on the front and those that aren't pruned, the chosen one first, without overlaps."""
    taken: list[np.ndarray] = []
    named = [point for point in points if point["front"] or point["pruning_db"] is None]
    for point in sorted(named, key=lambda point: not point["chosen"]):
        at = cost(point), _rms(point["error"]["psnr_worst"])
        place = axes.transData.transform(at)
        if all((np.abs(place - other) > LABEL_SIZE).any() for other in taken):
            left = axes.transAxes.inverted().transform(place)[0] > LABELED_LEFT
            side, offset = ("right", (-9, -11)) if left else ("left", (9, -11))
            axes.annotate(_text(point), at, offset, textcoords="offset points", ha=side, fontsize=8, zorder=5)
            taken.append(place)


def _text(point: dict[str, Any]) -> str:
    pruned = "unpruned" if point["pruning_db"] is None else f"pruned to {point['pruning_db']:g}"
    return f"{point['plan']}, {pruned}, SH {point['sh_degree']}"


def _set_ticks(axes: Any, cost: Cost, points: list[dict[str, Any]]) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    decibels = [point["error"]["psnr_worst"] for point in points]
    ticks = np.arange(DB_STEP * np.floor(min(decibels) / DB_STEP), min(max(decibels), MAX_DB) + DB_STEP, DB_STEP)
    axes.yaxis.set_major_locator(FixedLocator([_rms(db) for db in ticks]))
    axes.yaxis.set_major_formatter(FixedFormatter([f"{db:.0f} dB\n{100 * _rms(db):.2g} %" for db in ticks]))
    axes.yaxis.set_minor_locator(NullLocator())
    costs = [cost(point) for point in points]
    low, high = min(costs) / 1.15, max(costs) * 1.5
    every = [[base * 10.0**power for power in range(-3, 6) for base in bases] for bases in TICKS]
    inside = [[place for place in places if low <= place <= high] for places in every]
    places = next((places for places in inside if len(places) <= MAX_TICKS), inside[-1])
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

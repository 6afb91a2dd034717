"""The table and the plots of a comparison."""

import dataclasses
import itertools
import json
import os
import platform
from collections.abc import Callable, Iterable, Sequence
from datetime import date
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from msdgs_serve.writing import replacing, write_text
from msdgs_train.comparison.best import best_as_markdown
from msdgs_train.comparison.gains import mean_and_deviation, scenes_as_markdown
from msdgs_train.comparison.results import Result
from msdgs_train.comparison.rows import Row
from msdgs_train.evaluation.report import markdown_table
from msdgs_train.layers.parts import to_text

TABLE, NUMBERS, TIME_PLOT, LAYERS_PLOT = "comparison.md", "comparison.json", "time.png", "layers.png"
HEADINGS = (
    "system", "scene", "seeds", "PSNR, dB", "SSIM", "deformation parameters", "with modulation",
    "Gaussians or vertices", "training, s", "frame, ms",
)  # fmt: skip
BESIDE = 0.04  # horizontal offset between bars of the same K, in layers
SAME, ROOM = 1.001, 1.1  # ratios of errors
COLORS, DASHES = [f"C{i}" for i in range(10)], ["-", "--", ":", "-."]

_system = attrgetter("run.system")


def write_comparison(
    out: Path, results: Sequence[Result], rows: Sequence[Row], systems: Sequence[str], missing: int
) -> list[Path]:
    """Write the tables, their numbers and the plots into the folder `out`, each atomically; returns their paths.

    Args:
        results: those of the runs in this folder.
        rows: those of all finished runs; gains are over the first of the `systems`.
        missing: number of unfinished runs.
    """
    out.mkdir(parents=True, exist_ok=True)
    text = [as_markdown(results)] if results else []
    if rows:
        text += [scenes_as_markdown(rows, systems), best_as_markdown(rows, systems)]
    if missing:
        text.append(f"{missing} runs are not finished and are not in the tables.\n")
    write_text(out / TABLE, "\n".join(text))
    if not results:
        return [out / TABLE]
    write_text(out / NUMBERS, json.dumps(as_json(results, missing), indent=2) + "\n")
    save_figure(draw_time(results), out / TIME_PLOT)
    save_figure(draw_layers(results), out / LAYERS_PLOT)
    return [out / name for name in (TABLE, NUMBERS, TIME_PLOT, LAYERS_PLOT)]


def table(results: Sequence[Result]) -> list[list[str]]:
    """Return one row per system and scene, in the order of `HEADINGS`: mean ± sample standard deviation over seeds."""
    return [_row(group) for group in _groups(results, attrgetter("run.system", "run.scene")).values()]


def _row(group: list[Result]) -> list[str]:
    first = group[0]
    return [
        first.run.system,
        first.run.scene,
        str(len(group)),
        mean_and_deviation([r.psnr for r in group], 2),
        mean_and_deviation([r.ssim for r in group], 4),
        f"{first.deformation_parameters:,}",
        mean_and_deviation([r.deformation_parameters + r.modulation_parameters for r in group], 0),
        mean_and_deviation([r.gaussians for r in group], 0),
        mean_and_deviation([r.seconds for r in group], 0),
        mean_and_deviation([r.frame_ms for r in group], 1),
    ]


def as_markdown(results: Sequence[Result]) -> str:
    """Return the table and the conditions of the measurement as Markdown."""
    run = results[0].run.config.run
    kind = "minutes of CPU time" if run.time == "cpu" else "minutes"
    length = f"{run.steps:,} steps" if run.minutes is None else f"{run.minutes:g} {kind} per run"
    splits = " or ".join(f"`{split}`" for split in dict.fromkeys(result.split for result in results))
    conditions = f"{length}; {run.threads} thread(s) per run; held-out images of {splits}; "
    conditions += "mean ± standard deviation over the seeds; the last model of each run."
    machine = f"{platform.machine()}, {os.cpu_count()} cores, torch {torch.__version__}"
    notes = [conditions, f"Measured on {date.today().isoformat()}: {machine}."]
    skipped = sum(result.skipped for result in results)
    if skipped:
        notes.append(f"{skipped} steps were skipped because their loss was not finite.")
    return "\n".join([markdown_table(HEADINGS, table(results)), "", *notes]) + "\n"


def as_json(results: Sequence[Result], missing: int) -> dict[str, Any]:
    """Return all numbers of all runs as plain values for JSON."""

    def plain(result: Result) -> dict[str, Any]:
        values = {field.name: getattr(result, field.name) for field in dataclasses.fields(result)}
        run = {"system": result.run.system, "scene": result.run.scene, "seed": result.run.seed}
        return run | values | {"run": str(result.run.folder), "curve": [point._asdict() for point in result.curve]}

    return {"missing": missing, "runs": [plain(result) for result in results]}


def draw_time(results: Sequence[Result]) -> Figure:
    """Plot error on held-out images against training time: a panel per scene, a line per system (mean over seeds)."""
    figure, panels = _panels(results, "seconds of training")
    styles = _styles(_groups(results, _system))
    for axes, of_scene in panels:
        for name, group in _groups(of_scene, _system).items():
            shortest = min(len(result.curve) for result in group)
            curves = np.array([[(p.seconds, p.psnr) for p in result.curve[:shortest]] for result in group])
            seconds, errors = curves[..., 0].mean(axis=0), rms_error(curves[..., 1])
            axes.plot(seconds, errors.mean(axis=0), marker="o", ms=3, label=name, **styles[name])
            if len(group) > 1:
                low, high = errors.min(axis=0), errors.max(axis=0)
                axes.fill_between(seconds, low, high, color=styles[name]["color"], alpha=0.15, lw=0)
    return _completed(figure)


def draw_layers(results: Sequence[Result]) -> Figure:
    """Plot error against K, one panel per scene. Systems that differ only in their number of equal layers are joined by
    a line; bars reach from the best seed to the worst."""
    figure, panels = _panels(results, "K, layers of the deformation")
    families = list(_groups(results, _family))
    styles = _styles(families)
    for axes, of_scene in panels:
        for key, family in _groups(of_scene, _family).items():
            offset, points = BESIDE * (families.index(key) - (len(families) - 1) / 2), []
            for num_layers, group in _groups(family, lambda r: len(r.run.config.model.layers)).items():
                errors = rms_error(np.array([result.psnr for result in group]))
                points.append((num_layers, errors.mean(), errors.min(), errors.max()))
            count, mean, low, high = np.array(sorted(points)).T
            name = "\n".join(_groups(family, _system))
            bars = [mean - low, high - mean]
            axes.errorbar(count + offset, mean, bars, marker="o", ms=4, capsize=3, label=name, **styles[key])
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    return _completed(figure)


def rms_error(psnr: np.ndarray) -> np.ndarray:
    """Convert a PSNR in dB to the root mean square error of pixels in [0, 1]."""
    return 10 ** (-psnr / 20)


def _family(result: Result) -> str:
    config = result.run.config
    kinds = "+".join(sorted({to_text(layer) for layer in config.model.layers}))
    rest = config.updated(seed=0, model=dataclasses.replace(config.model, layers=())).to_dict()
    return kinds + json.dumps(rest)


def _panels(results: Sequence[Result], label: str) -> tuple[Figure, list[tuple[Axes, list[Result]]]]:
    """Return a figure with one panel per scene, and the results of each."""
    scenes = _groups(results, attrgetter("run.scene"))
    figure = Figure(figsize=(2.5 + 5.5 * len(scenes), 5.5), layout="constrained")
    panels: list[Axes] = list(np.ravel(figure.subplots(1, len(scenes), squeeze=False)))
    for axes, scene in zip(panels, scenes, strict=True):
        axes.set(title=scene, xlabel=label, yscale="log")
        axes.grid(alpha=0.3, which="both")
    panels[0].set_ylabel("root mean square error of held-out pixels in [0, 1]")
    return figure, list(zip(panels, scenes.values(), strict=True))


def _completed(figure: Figure) -> Figure:
    """Add the legend, and room around errors that are all the same: matplotlib gives a logarithmic axis none."""
    for axes in figure.axes:
        low, high = axes.dataLim.intervaly
        if high < low * SAME:
            axes.set_autoscaley_on(False)
            axes.set_ylim(low / ROOM, high * ROOM)
    entries = [axes.get_legend_handles_labels() for axes in figure.axes]
    labelled = {label: handle for handles, labels in entries for handle, label in zip(handles, labels, strict=True)}
    figure.legend(list(labelled.values()), list(labelled), loc="outside right upper", fontsize="small")
    return figure


def _styles(names: Iterable[str]) -> dict[str, dict[str, Any]]:
    styles = itertools.cycle({"color": color, "linestyle": dashes} for dashes in DASHES for color in COLORS)
    return dict(zip(names, styles, strict=False))


def _groups(results: Sequence[Result], key: Callable[[Result], Any]) -> dict[Any, list[Result]]:
    """Group results by key, in the order of the first result of each."""
    groups: dict[Any, list[Result]] = {}
    for result in results:
        groups.setdefault(key(result), []).append(result)
    return groups


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure as PNG, atomically."""
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=110)

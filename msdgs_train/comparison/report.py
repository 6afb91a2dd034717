"""The table and the plots of a comparison."""

import dataclasses
import itertools
import json
import os
import platform
from collections.abc import Callable, Sequence
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from msdgs_train.comparison.results import Result, Spread
from msdgs_train.datasets.common.files import replacing, write_text
from msdgs_train.layers.parts import to_text

TABLE, NUMBERS, TIME_PLOT, LAYERS_PLOT = "comparison.md", "comparison.json", "time.png", "layers.png"
HEADINGS = (
    "system", "scene", "seeds", "PSNR, dB", "SSIM", "deformation parameters", "with modulation", "Gaussians",
    "training, s", "frame, ms",
)  # fmt: skip
BESIDE = 0.04  # horizontal offset between bars of the same K, in layers
COLORS, DASHES = [f"C{i}" for i in range(10)], ["-", "--", ":", "-."]


def write_comparison(out: Path, results: Sequence[Result], missing: int) -> list[Path]:
    """Write the table, its numbers and the plots into the folder `out`, each atomically; returns their paths.

    `missing`: number of unfinished runs.
    """
    write_text(out / TABLE, as_markdown(results, missing))
    write_text(out / NUMBERS, json.dumps(as_json(results, missing), indent=2) + "\n")
    _save(draw_time(results), out / TIME_PLOT)
    _save(draw_layers(results), out / LAYERS_PLOT)
    return [out / name for name in (TABLE, NUMBERS, TIME_PLOT, LAYERS_PLOT)]


def table(results: Sequence[Result]) -> list[list[str]]:
    """One row per system and scene, in the order of `HEADINGS`: mean ± sample standard deviation over seeds."""
    return [_row(group) for group in _groups(results, lambda r: (r.run.system, r.run.scene))]


def _row(group: list[Result]) -> list[str]:
    first = group[0]

    def shown(values: list[float], digits: int) -> str:
        return Spread.of(values).shown(digits)

    return [
        first.run.system,
        first.run.scene,
        str(len(group)),
        shown([r.psnr for r in group], 2),
        shown([r.ssim for r in group], 4),
        f"{first.deformation_parameters:,}",
        shown([r.deformation_parameters + r.modulation_parameters for r in group], 0),
        shown([r.gaussians for r in group], 0),
        shown([r.seconds for r in group], 0),
        shown([r.frame_ms for r in group], 1),
    ]


def as_markdown(results: Sequence[Result], missing: int) -> str:
    """The table and the conditions of the measurement."""
    lines = ["| " + " | ".join(HEADINGS) + " |", "|" + "---|" * len(HEADINGS)]
    lines += ["| " + " | ".join(row) + " |" for row in table(results)]
    budget = results[0].run.config
    limit = f", at most {budget.run.max_minutes:g} minutes a run" if budget.run.max_minutes is not None else ""
    conditions = f"{budget.run.steps:,} steps{limit}; {budget.run.threads} thread(s) a run; held-out images of "
    conditions += f"`{results[0].split}`; mean ± standard deviation over the seeds; the last model of each run."
    machine = f"{platform.machine()}, {os.cpu_count()} cores, torch {torch.__version__}"
    notes = [conditions, f"Measured on {date.today().isoformat()}: {machine}."]
    skipped = sum(result.skipped for result in results)
    if skipped:
        notes.append(f"{skipped} steps were skipped because their loss was not finite.")
    if missing:
        notes.append(f"{missing} runs are not finished and are not in the table.")
    return "\n".join([*lines, "", *notes]) + "\n"


def as_json(results: Sequence[Result], missing: int) -> dict[str, Any]:
    """All numbers of all runs."""

    def plain(result: Result) -> dict[str, Any]:
        values = {field.name: getattr(result, field.name) for field in dataclasses.fields(result)}
        run = {"system": result.run.system, "scene": result.run.scene, "seed": result.run.seed}
        return run | values | {"run": str(result.run.folder), "curve": [point._asdict() for point in result.curve]}

    return {"missing": missing, "runs": [plain(result) for result in results]}


def draw_time(results: Sequence[Result]) -> Figure:
    """Error on held-out images against training time: one panel per scene, one line per system (mean over seeds)."""
    figure, panels = _panels(results, "seconds of training")
    styles = _styles(_names(results, lambda r: r.run.system))
    for axes, of_scene in panels:
        for group in _groups(of_scene, lambda r: r.run.system):
            shortest = min(len(result.curve) for result in group)
            seconds, psnr = (
                np.array([[getattr(point, name) for point in result.curve[:shortest]] for result in group])
                for name in ("seconds", "psnr")
            )
            at, errors, name = seconds.mean(axis=0), rms_error(psnr), group[0].run.system
            axes.plot(at, errors.mean(axis=0), marker="o", ms=3, label=name, **styles[name])
            if len(group) > 1:
                low, high = errors.min(axis=0), errors.max(axis=0)
                axes.fill_between(at, low, high, color=styles[name]["color"], alpha=0.15, lw=0)
    return _finished(figure)


def draw_layers(results: Sequence[Result]) -> Figure:
    """Error against K, one panel per scene. Systems that differ only in their number of equal layers are joined by a
    line; bars reach from the best seed to the worst."""
    figure, panels = _panels(results, "K, layers of the deformation")
    families = _names(results, _family)
    styles = _styles(families)
    for axes, of_scene in panels:
        for family in _groups(of_scene, _family):
            key, points = _family(family[0]), []
            aside = BESIDE * (families.index(key) - (len(families) - 1) / 2)
            for group in _groups(family, lambda r: len(r.run.config.model.layers)):
                errors = rms_error(np.array([result.psnr for result in group]))
                points.append((len(group[0].run.config.model.layers), errors.mean(), errors.min(), errors.max()))
            count, mean, low, high = np.array(sorted(points)).T
            name = "\n".join(_names(family, lambda r: r.run.system))
            bars = [mean - low, high - mean]
            axes.errorbar(count + aside, mean, bars, marker="o", ms=4, capsize=3, label=name, **styles[key])
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    return _finished(figure)


def rms_error(psnr: np.ndarray) -> np.ndarray:
    """Root mean square error of pixels in [0, 1] of a PSNR in dB."""
    return 10 ** (-psnr / 20)


def _family(result: Result) -> str:
    config = result.run.config
    kinds = "+".join(sorted({to_text(layer) for layer in config.model.layers}))
    rest = config.updated(seed=0, model=dataclasses.replace(config.model, layers=())).to_dict()
    return kinds + json.dumps(rest)


def _panels(results: Sequence[Result], label: str) -> tuple[Figure, list[tuple[Axes, list[Result]]]]:
    """A figure with one panel per scene, and the results of each."""
    scenes = _groups(results, lambda r: r.run.scene)
    figure = Figure(figsize=(2.5 + 5.5 * len(scenes), 5.5), layout="constrained")
    panels: list[Axes] = list(np.ravel(figure.subplots(1, len(scenes), squeeze=False)))
    for axes, of_scene in zip(panels, scenes, strict=True):
        axes.set(title=of_scene[0].run.scene, xlabel=label, yscale="log")
        axes.grid(alpha=0.3, which="both")
    panels[0].set_ylabel("root mean square error of held-out pixels in [0, 1]")
    return figure, list(zip(panels, scenes, strict=True))


def _finished(figure: Figure) -> Figure:
    entries = [axes.get_legend_handles_labels() for axes in figure.axes]
    labelled = {label: handle for handles, labels in entries for handle, label in zip(handles, labels, strict=True)}
    figure.legend(list(labelled.values()), list(labelled), loc="outside right upper", fontsize="small")
    return figure


def _styles(names: list[str]) -> dict[str, dict[str, Any]]:
    styles = itertools.cycle({"color": color, "linestyle": dashes} for dashes in DASHES for color in COLORS)
    return dict(zip(names, styles, strict=False))


def _names(results: Sequence[Result], key: Callable[[Result], str]) -> list[str]:
    return list(dict.fromkeys(map(key, results)))


def _groups(results: Sequence[Result], key: Any) -> list[list[Result]]:
    """Groups in the order of their first result."""
    groups: dict[Any, list[Result]] = {}
    for result in results:
        groups.setdefault(key(result), []).append(result)
    return list(groups.values())


def _save(figure: Figure, path: Path) -> None:
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=110)

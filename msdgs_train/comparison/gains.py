"""PSNR by scene, and gains over the first system with their intervals, from the rows of runs."""

import statistics
from collections.abc import Sequence

import numpy as np

from msdgs_train.comparison.rows import Row
from msdgs_train.comparison.scenes import SPLITS
from msdgs_train.evaluation.report import markdown_table

RESAMPLES = 2000
INTERVAL = (2.5, 97.5)  # percentiles of the bootstrap


def scenes_as_markdown(rows: Sequence[Row], systems: Sequence[str]) -> str:
    """A line per scene, and the mean over the scenes that all systems have; a column per system and split."""
    scenes = _scenes(rows)
    lines = [[scene, *(_cell(rows, scene, system, s) for s in SPLITS for system in systems)] for scene in scenes]
    means = [_mean_over_scenes(rows, scenes, systems, split) for split in SPLITS]
    lines.append(["mean", *(f"{value:.2f}" if value is not None else "–" for of_split in means for value in of_split)])
    headings = ["scene", *(f"{system}, {split}" for split in SPLITS for system in systems)]
    shown = [markdown_table(headings, lines)]
    if len(systems) > 1:
        gains = [
            [name, *(gain(rows, of, system, systems[0]) for system in systems[1:])]
            for name, of in [*((scene, [scene]) for scene in scenes), ("mean", scenes)]
        ]
        shown += ["", f"Gain over {systems[0]} on test images, dB, with the 95 % interval over images:", ""]
        shown.append(markdown_table(["scene", *systems[1:]], gains))
    days = sorted({row["date"] for row in rows})
    notes = f"PSNR in dB of the last model, mean ± standard deviation over seeds; {_budget(rows[0])} "
    notes += f"on {rows[0]['threads']} thread(s) of {machines_of(rows)}; {days[0]} to {days[-1]}. "
    notes += "The mean is over scenes that all systems have, "
    notes += "that of a gain over scenes that both systems have."
    return "\n".join([*shown, "", notes]) + "\n"


def _budget(row: Row) -> str:
    if not row["minutes"]:
        return f"{int(row['optimizer_steps']):,} steps per run"
    return f"{row['minutes']} {'minutes of CPU time' if row['time'] == 'cpu' else 'minutes'} per run"


def mean_and_deviation(values: Sequence[float], digits: int) -> str:
    """Format mean ± sample standard deviation; of a single value only the value."""
    deviation = f" ± {statistics.stdev(values):,.{digits}f}" if len(values) > 1 else ""
    return f"{statistics.fmean(values):,.{digits}f}{deviation}"


def paired_gain(gains: Sequence[np.ndarray]) -> tuple[float, float, float]:
    """Mean over scenes of the mean gain over images, and the limits of its 95 % bootstrap interval over the images of
    each scene; seeded.

    Args:
        gains: an array per scene, the difference between two systems for each image.
    """
    generator = np.random.default_rng(0)
    drawn = [of[generator.integers(len(of), size=(RESAMPLES, len(of)))].mean(axis=1) for of in gains]
    low, high = np.percentile(np.mean(drawn, axis=0), INTERVAL)
    return float(np.mean([of.mean() for of in gains])), float(low), float(high)


def _scenes(rows: Sequence[Row]) -> list[str]:
    return list(dict.fromkeys(row["scene"] for row in rows))


def machines_of(rows: Sequence[Row]) -> str:
    """The machines on which the rows were measured."""
    return " and ".join(sorted({row["machine"] for row in rows}))


def values_of(rows: Sequence[Row], scene: str, system: str, name: str) -> list[str]:
    """A column of the rows of a scene and a system, without empty ones."""
    return [row[name] for row in rows if (row["scene"], row["system"]) == (scene, system) and row[name]]


def _images_by_seed(rows: Sequence[Row], scene: str, system: str) -> dict[str, np.ndarray]:
    found = [row for row in rows if (row["scene"], row["system"]) == (scene, system) and row["test_images"]]
    return {row["seed"]: np.array(row["test_images"].split(), float) for row in found}


def _cell(rows: Sequence[Row], scene: str, system: str, split: str) -> str:
    found = [float(value) for value in values_of(rows, scene, system, f"{split}_psnr")]
    return mean_and_deviation(found, 2) if found else "–"


def _mean_over_scenes(
    rows: Sequence[Row], scenes: Sequence[str], systems: Sequence[str], split: str
) -> list[float | None]:
    cells = [[values_of(rows, scene, system, f"{split}_psnr") for system in systems] for scene in scenes]
    complete = [[statistics.fmean(map(float, values)) for values in cell] for cell in cells if all(cell)]
    return [statistics.fmean(column) for column in zip(*complete, strict=True)] or [None] * len(systems)


def gain(rows: Sequence[Row], scenes: Sequence[str], system: str, first: str) -> str:
    """The gain of `system` over `first` on test images and its interval, as text; – if no scene has both.

    The mean is over scenes that both systems have, and over images, each the mean over the seeds that both have.
    """
    gains = []
    for scene in scenes:
        old, new = (_images_by_seed(rows, scene, name) for name in (first, system))
        if both := [new[seed] - old[seed] for seed in sorted(old.keys() & new.keys())]:
            gains.append(np.mean(both, axis=0))
    if not gains:
        return "–"
    mean, low, high = paired_gain(gains)
    return f"{mean:+.2f} ({low:+.2f} to {high:+.2f})"

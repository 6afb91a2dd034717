"""The benchmark of many scenes: its runs, and a row of a CSV file for each finished one.

Settings are chosen by the mean over scenes of PSNR on `val` images; `test` images, which no choice has seen, are
reported. A run that has a row isn't trained again.
"""

import csv
import fcntl
import hashlib
import io
import json
import os
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path

import torch
from llvmlite.binding import get_host_cpu_name

from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.writing import write_text
from msdgs_train.comparison.matrix import Run, require_unique
from msdgs_train.comparison.pools import RunEnd, processes
from msdgs_train.comparison.runner import final_metrics, train_all
from msdgs_train.engine.config import TrainConfig
from msdgs_train.engine.metrics_log import read_metrics
from msdgs_train.evaluation.evaluate import evaluate_run

SCENES = Path(__file__).with_name("bench.toml")
SPLITS = ("val", "test")
KEY = ("scene", "system", "seed", "minutes", "time", "threads", "settings")
COLUMNS = (
    "date", "machine", *KEY, "seconds", "optimizer_steps", "gaussians", "train_psnr",
    *(f"{split}_{name}" for split in SPLITS for name in ("psnr", "ssim", "lpips", "moving_psnr", "images")),
)  # fmt: skip
"""`*_images` has the PSNR of each image, in order; `*_moving_psnr` only where the region is known from the images;
`train_psnr` is the moving average of the last steps."""

Row = dict[str, str]


@dataclass(frozen=True)
class BenchScene:
    """A dataset at one size."""

    name: str
    folder: Path
    size: int
    llffhold: int = 0
    splits: tuple[str, ...] = SPLITS
    short: bool = False
    """Whether it is trained on without `--whole`."""
    time_from: str | None = None


def read_scenes(data: Path, *, short: bool, names: Sequence[str] = (), file: Path = SCENES) -> list[BenchScene]:
    """The scenes of the benchmark, or those with the given names, with folders below `data`.

    Raises `InvalidInput` if a name is unknown or a scene has no folder.
    """
    tables = tomllib.loads(file.read_text(encoding="utf-8"))
    unknown = [name for name in names if name not in tables]
    if unknown:
        raise InvalidInput("scenes", f"of {', '.join(tables)}", unknown[0])
    scenes = [BenchScene(name, **{**table, "folder": data / table["folder"]}) for name, table in tables.items()]
    chosen = [scene for scene in scenes if (scene.name in names if names else scene.short or not short)]
    missing = sorted({scene.folder.name for scene in chosen if not scene.folder.is_dir()})
    if missing:
        raise InvalidInput("data", f"a folder with datasets named {', '.join(missing)}", data)
    return chosen


def make_bench_runs(
    systems: Mapping[str, TrainConfig], scenes: Sequence[BenchScene], seeds: Sequence[int], out: Path
) -> list[Run]:
    """One run per seed, scene and system, in this order: a benchmark that is stopped compares all systems."""
    require_unique("seed", map(str, seeds))
    return [
        Run(name, scene.name, seed, scene.folder.resolve(),
            out / name / "_".join([scene.name, str(seed), *filter(None, _budget(config)), _digest(config)]),
            config.updated(seed=seed, size=scene.size, llffhold=scene.llffhold, time_from=scene.time_from))
        for seed in seeds
        for scene in scenes
        for name, config in systems.items()
    ]  # fmt: skip


def key_of(run: Run) -> tuple[str, ...]:
    """The values of `KEY`, which tell the rows of a CSV file apart."""
    return run.scene, run.system, str(run.seed), *_budget(run.config), _digest(run.config)


def _budget(config: TrainConfig) -> tuple[str, str, str]:
    """Minutes, their kind, and threads."""
    minutes = "" if config.run.minutes is None else f"{config.run.minutes:g}"
    return minutes, config.run.time, str(config.run.threads)


def key_of_row(row: Row) -> tuple[str, ...]:
    """The same of a row."""
    return tuple(row[name] for name in KEY)


def _digest(config: TrainConfig) -> str:
    """Eight digits that change with any setting besides those of `KEY`, the scene's and the machine's."""
    same = config.updated(seed=0, size=None, llffhold=0, minutes=None, threads=1, time="wall")
    groups = same.to_dict()
    del groups["data"]["time_from"]  # the scene's
    if config.run.device == "cpu":
        del groups["run"]["device"]  # only another device changes the digest
    return hashlib.sha256(json.dumps(groups, sort_keys=True).encode()).hexdigest()[:8]


def read_rows(path: Path) -> list[Row]:
    """The rows of a CSV file; none if there is no such file. Raises `InvalidInput` if it has other columns."""
    if not path.exists():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        reader = csv.DictReader(file)
        if tuple(reader.fieldnames or ()) != COLUMNS:
            raise InvalidInput("csv", f"a file with the columns {', '.join(COLUMNS)}", path)
        return list(reader)


def append_row(path: Path, row: Row) -> None:
    """Add a row, atomically, also while other processes add theirs."""
    path.parent.mkdir(parents=True, exist_ok=True)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        fcntl.flock(folder, fcntl.LOCK_EX)
        text = io.StringIO()
        writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows([*read_rows(path), row])
        write_text(path, text.getvalue())
    finally:
        os.close(folder)


def train_and_measure(
    runs: Sequence[Run], scenes: Sequence[BenchScene], csv_file: Path, jobs: int, on_end: Callable[[Run, RunEnd], None]
) -> bool:
    """Train the runs that have no row in the file, and add their rows; returns False if Ctrl-C has stopped it."""
    by_name = {scene.name: scene for scene in scenes}

    def finish(run: Run, end: RunEnd) -> None:
        on_end(run, end)
        if end.status in ("finished", "was finished"):
            append_row(csv_file, measure(run, by_name[run.scene]))

    return train_all(runs_left(runs, csv_file), processes(jobs), finish)


def runs_left(runs: Sequence[Run], csv_file: Path) -> list[Run]:
    """The runs that have no row in the file."""
    done = set(map(key_of_row, read_rows(csv_file)))
    return [run for run in runs if key_of(run) not in done]


def rows_of(runs: Sequence[Run], csv_file: Path) -> list[Row]:
    """The rows of these runs in the file, in the order of the runs."""
    found = {key_of_row(row): row for row in read_rows(csv_file)}
    return [found[key_of(run)] for run in runs if key_of(run) in found]


def measure(run: Run, scene: BenchScene) -> Row:
    """The row of a finished run: metrics of its last model on the images of all splits."""
    metrics = final_metrics(run) or {}
    row = dict(zip(KEY, key_of(run), strict=True)) | {
        "date": date.today().isoformat(),
        "machine": _machine(run.config.run.device),
        "seconds": f"{metrics['seconds']:.0f}",
        "optimizer_steps": str(metrics["optimizer_steps"]),
        "gaussians": str(metrics["gaussians"]),
        "train_psnr": f"{[line for line in read_metrics(run.folder) if line['kind'] == 'train'][-1]['psnr']:.3f}",
    }
    for split in SPLITS:
        found = split in scene.splits and split in metrics["splits"]
        row |= {f"{split}_{name}": value for name, value in (_scores(run, split) if found else {}).items()}
    return {name: row.get(name, "") for name in COLUMNS}


def _machine(device: str) -> str:
    gpu = f", {torch.cuda.get_device_name()}" if device == "cuda" else ""
    return f"{get_host_cpu_name()} {os.cpu_count()} cores{gpu}"


def _scores(run: Run, split: str) -> dict[str, str]:
    evaluation = evaluate_run(run.folder, run.data, split, brief=True)
    (model,) = evaluation.models
    mean = model.mean
    moving = mean.moving_psnr if evaluation.region_source == "images" else None
    numbers = {"psnr": mean.psnr, "ssim": mean.ssim, "lpips": mean.lpips, "moving_psnr": moving}
    texts = {name: f"{value:.4f}" for name, value in numbers.items() if value is not None}
    return texts | {"images": " ".join(f"{image.psnr:.2f}" for image in model.images)}

"""A row of a CSV file for each finished run of a comparison. A run that has a row isn't trained again."""

import csv
import fcntl
import hashlib
import io
import json
import os
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from datetime import date
from pathlib import Path
from typing import Any

import torch
from llvmlite.binding import get_host_cpu_name

from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.writing import write_text
from msdgs_train.comparison.matrix import Run
from msdgs_train.comparison.pools import Pool, RunEnd
from msdgs_train.comparison.runner import final_metrics, train_all
from msdgs_train.comparison.scenes import SPLITS
from msdgs_train.datasets import load_scene
from msdgs_train.datasets.config import DataConfig
from msdgs_train.datasets.identity import identity
from msdgs_train.engine.metrics_log import read_metrics
from msdgs_train.engine.run_record import read_config, read_record, require_same_dataset
from msdgs_train.evaluation.evaluate import Evaluation, evaluate_run

BEST, DATASET = ("best_split", "best_step", "best_psnr"), "dataset"
KEY = ("scene", "system", "seed", "minutes", "time", "threads", "settings")
COLUMNS = (
    "date", "machine", *KEY, "seconds", "optimizer_steps", "gaussians", "parameters", "modulation_parameters",
    "train_psnr",
    *(f"{split}_{name}" for split in SPLITS for name in ("psnr", "ssim", "lpips", "lpips_01", "moving_psnr", "images")),
    *BEST, DATASET,
)  # fmt: skip
"""`parameters` are those of the deformation; those of the modulation, embeddings included, are apart. `*_images` has
the PSNR of each image, in order; `*_moving_psnr` only where the region is known from the images; `train_psnr` is the
moving average of the last steps. `best_*` are of the best evaluation during training, by the PSNR of a split, and
`dataset` is a digest of its images, times and cameras; rows of earlier versions lack them."""

TEXTS = {"date", "machine", "scene", "system", "time", "settings", "best_split", DATASET}
"""Columns that aren't numbers."""

Row = dict[str, str]


def key_of(run: Run) -> tuple[str, ...]:
    """The values of `KEY`, which tell the rows of a CSV file apart."""
    budget = run.config.run
    minutes = "" if budget.minutes is None else f"{budget.minutes:g}"
    return run.scene, run.system, str(run.seed), minutes, budget.time, str(budget.threads), run.settings


def key_of_row(row: Row) -> tuple[str, ...]:
    """The same of a row."""
    return tuple(row[name] for name in KEY)


def read_rows(path: Path) -> list[Row]:
    """The rows of a CSV file; none if there is no such file. `BEST` and `DATASET` are empty where columns are missing.

    Raises `InvalidInput` if it has other columns, or naming a line that is incomplete or whose numbers are none.
    """
    if not path.exists():
        return []
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            columns = tuple(reader.fieldnames or ())
            if columns not in (COLUMNS, COLUMNS[:-1], COLUMNS[: -1 - len(BEST)]):
                raise InvalidInput("csv", f"a file with the columns {', '.join(COLUMNS)}", path)
            rows = []
            for row in reader:
                _require_sound(row, f"line {reader.line_num} of {path}")
                rows.append(dict.fromkeys((*BEST, DATASET), "") | row)
            return rows
    except (UnicodeDecodeError, csv.Error) as error:
        raise InvalidInput("csv", f"a CSV file in UTF-8 ({error})", path) from error


def _require_sound(row: dict[Any, Any], place: str) -> None:
    if None in row or None in row.values():
        raise InvalidInput("csv", "made of complete lines; remove those that aren't", place)
    for name in (name for name in row if name not in TEXTS):
        try:
            [float(number) for number in row[name].split()]
        except ValueError:
            raise InvalidInput("csv", f"made of numbers in the column {name}", f"{row[name]!r} in {place}") from None


def append_row(path: Path, row: Row) -> None:
    """Add a row, atomically, also while other processes add theirs; if another one has added this run, it stays."""
    path.parent.mkdir(parents=True, exist_ok=True)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        fcntl.flock(folder, fcntl.LOCK_EX)
        text = io.StringIO()
        writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
        writer.writeheader()
        rows = read_rows(path)
        if key_of_row(row) not in map(key_of_row, rows):
            writer.writerows([*rows, row])
            write_text(path, text.getvalue())
    finally:
        os.close(folder)


def train_and_measure(
    runs: Sequence[Run], csv_file: Path, pool: AbstractContextManager[Pool], on_end: Callable[[Run, RunEnd], None]
) -> bool:
    """Train the runs that have no row in the file, and add their rows; returns False if Ctrl-C has stopped it.

    Raises `InvalidInput` if a row or a run of another dataset is in the way, whose folder had the same name.
    """
    _require_same_datasets(runs, csv_file)

    def finish(run: Run, end: RunEnd) -> None:
        if end.status in ("finished", "was finished"):
            append_row(csv_file, measure(run))
        on_end(run, end)

    return train_all(runs_left(runs, csv_file), pool, finish)


def runs_left(runs: Sequence[Run], csv_file: Path) -> list[Run]:
    """The runs that have no row in the file."""
    done = set(map(key_of_row, read_rows(csv_file)))
    return [run for run in runs if key_of(run) not in done]


def rows_of(runs: Sequence[Run], csv_file: Path) -> list[Row]:
    """The rows of these runs in the file, in the order of the runs."""
    found = {key_of_row(row): row for row in read_rows(csv_file)}
    return [found[key_of(run)] for run in runs if key_of(run) in found]


def measure(run: Run) -> Row:
    """The row of a finished run: metrics of its last model on the images of all splits."""
    metrics = final_metrics(run) or {}
    row = dict(zip(KEY, key_of(run), strict=True)) | {
        "date": date.today().isoformat(),
        DATASET: _digest(dataset_of(run)),
        "machine": _machine(run.config.run.device),
        "seconds": f"{metrics['seconds']:.0f}",
        "optimizer_steps": str(metrics["optimizer_steps"]),
        "gaussians": str(metrics["gaussians"]),
        "train_psnr": f"{[line for line in read_metrics(run.folder) if line['kind'] == 'train'][-1]['psnr']:.3f}",
    }
    if best := metrics["best"]:
        row |= {"best_split": best["split"], "best_step": str(best["step"]), "best_psnr": f"{best['psnr']:.4f}"}
    for split in SPLITS:
        if split in run.splits and split in metrics["splits"]:
            evaluation = evaluate_run(run.folder, run.data, split, brief=True)
            counts = evaluation.models[0].loaded.parameter_counts
            row |= dict(zip(("parameters", "modulation_parameters"), map(str, counts), strict=True))
            row |= {f"{split}_{name}": value for name, value in _scores(evaluation).items()}
    return {name: row.get(name, "") for name in COLUMNS}


def _machine(device: str) -> str:
    gpu = f", {torch.cuda.get_device_name()}" if device == "cuda" else ""
    return f"{get_host_cpu_name()} {os.cpu_count()} cores{gpu}"


def _scores(evaluation: Evaluation) -> dict[str, str]:
    (model,) = evaluation.models
    mean = model.mean
    moving = mean.moving_psnr if evaluation.region_source == "images" else None
    numbers = {name: getattr(mean, name) for name in ("psnr", "ssim", "lpips", "lpips_01")} | {"moving_psnr": moving}
    texts = {name: f"{value:.4f}" for name, value in numbers.items() if value is not None}
    return texts | {"images": " ".join(f"{image.psnr:.2f}" for image in model.images)}


def dataset_of(run: Run) -> dict[str, Any]:
    """The identity of the dataset that a run is trained on."""
    d = run.config.data
    return identity(load_scene(run.data, d.size, d.llffhold, d.time_from, d.masks))


def _digest(dataset: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(dataset, sort_keys=True).encode()).hexdigest()[:12]


def _require_same_datasets(runs: Sequence[Run], csv_file: Path) -> None:
    rows = {key_of_row(row): row for row in read_rows(csv_file)}
    datasets = dict[tuple[Path, DataConfig], dict[str, Any]]()
    for run in runs:
        row, record = rows.get(key_of(run)), read_record(run.folder)
        if record is not None and read_config(run.folder).data != run.config.data:
            record = None  # refused for its settings
        if record is None and not (row and row[DATASET]):
            continue
        source = run.data, run.config.data
        if source not in datasets:
            datasets[source] = dataset_of(run)
        if record is not None:
            require_same_dataset(run.folder, record, run.data, datasets[source])
        if row and row[DATASET] and row[DATASET] != _digest(datasets[source]):
            problem = f"that of another dataset named {run.scene} than {run.data}"
            raise InvalidInput("csv", "without rows of other datasets of the same names", f"{csv_file}: {problem}")

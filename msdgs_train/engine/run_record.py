"""The folder of a run: the names of its files, its settings, and `run.json`, which names its dataset and best model."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from msdgs_serve.scene.errors import InvalidInput, MsdgsError
from msdgs_serve.scene.similarity import IDENTITY, Similarity
from msdgs_serve.writing import reason, write_text
from msdgs_train.datasets.identity import differences
from msdgs_train.engine.config import TrainConfig

CONFIG = "config.json"
RECORD = "run.json"
CHECKPOINT = "checkpoint.pt"
MODEL = "model.pt"
BEST = "best.pt"
FINAL_METRICS = "metrics.json"
METRICS = "metrics.jsonl"
CURVE = "curve.png"
RENDERS = "renders"
LOCK = ".lock"

KEPT = (CONFIG, RECORD, CHECKPOINT, MODEL, BEST, FINAL_METRICS, METRICS, CURVE, RENDERS)
"""What another run would overwrite."""


class RunInvalid(MsdgsError):
    """A file of a run is missing or can't be read; the message names it."""

    def __init__(self, file: Path, problem: str) -> None:
        super().__init__(f"{file}: {problem}")


@dataclass(frozen=True)
class Best:
    """The model in `best.pt`: the one of the highest mean PSNR so far."""

    split: str  # the held-out images that it was selected on
    step: int
    psnr: float  # dB


@dataclass(frozen=True)
class RunRecord:
    """The contents of `run.json`."""

    data: Path  # absolute
    best: Best | None = None  # None until a split has been evaluated
    dataset: Mapping[str, Any] = field(default_factory=dict)  # its `identity`; empty in runs of earlier versions
    scene_to_world: Similarity = IDENTITY  # the frame that is trained in


def read_record(run: Path) -> RunRecord | None:
    """Read the contents of `run.json`, None if there is no such file. Raises `RunInvalid`."""
    path = run / RECORD
    if not path.exists():
        return None
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        best = values["best"]
        best = Best(str(best["split"]), int(best["step"]), float(best["psnr"])) if best else None
        frame = values.get("scene_to_world")  # missing in runs that were started in the frame of the files
        place = IDENTITY if frame is None else Similarity.from_plain(frame)
        return RunRecord(Path(values["data"]), best, dict(values.get("dataset", {})), place)
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError, InvalidInput):
        problem = "is damaged: delete it, and the run can be resumed without; `eval` then needs --data"
        raise RunInvalid(path, problem) from None


def write_record(run: Path, record: RunRecord) -> None:
    """Write `run.json`, atomically."""
    values = {
        "data": str(record.data),
        "best": asdict(record.best) if record.best else None,
        "dataset": record.dataset,
        "scene_to_world": record.scene_to_world.to_plain(),
    }
    write_text(run / RECORD, json.dumps(values, indent=2) + "\n")


def read_config(run: Path) -> TrainConfig:
    """Read the settings of a run. Raises `RunInvalid` if there are none, or those of another version."""
    path = run / CONFIG
    try:
        return TrainConfig.from_dict(json.loads(path.read_text(encoding="utf-8")))
    except OSError as error:
        problem = f"{reason(error)}; RUN must be the folder of a run of `msdgs-train fit DATA RUN`"
        raise RunInvalid(path, problem) from None
    except InvalidInput as error:
        problem = (
            f"isn't usable: {error}. Give the run's --plugin, if it had one; else it is of another version: train anew"
        )
        raise RunInvalid(path, problem) from None
    except (ValueError, AttributeError, TypeError, RecursionError):
        problem = "is damaged: put a copy of it there, or train again in a new folder"
        raise RunInvalid(path, problem) from None


def require_no_run(folder: Path) -> None:
    """Raise `InvalidInput` if a new run in `folder` would overwrite files of another."""
    if folder.exists() and not folder.is_dir():
        raise InvalidInput("run", "a new folder", f"{folder}, which is a file")
    held = [name for name in KEPT if (folder / name).exists()]
    if held:
        remedy = "--resume continues the run in it" if _is_resumable(folder) else "it can't be resumed"
        expected = "a new folder, or one that holds no run"
        raise InvalidInput("run", expected, f"{folder}, which holds {', '.join(held)}: {remedy}")


def remove_temporaries(run: Path) -> None:
    """Remove the temporary files of killed runs of version 0.2 and earlier. The run must be locked."""
    for name in map(Path, KEPT):
        for file in run.glob(f".{name.stem}.????????{name.suffix}"):
            file.unlink()


def stored_config(run: Path) -> TrainConfig:
    """Return the settings of a run that can be resumed. Raises `InvalidInput` if there is none, and `RunInvalid`."""
    if not (run / CONFIG).exists():
        raise InvalidInput("run", "the folder of a run, to resume it", f"{run}, which has no {CONFIG}")
    if not _is_resumable(run):
        problem = f"{run}, which has none: {MODEL} is whole, and a new folder starts again"
        raise InvalidInput("run", f"the folder of a run with its {CHECKPOINT}, to resume it", problem)
    return read_config(run)


def _is_resumable(run: Path) -> bool:
    """Whether a run has a checkpoint, or was stopped before its first: then it has no `model.pt`."""
    return (run / CONFIG).exists() and ((run / CHECKPOINT).exists() or not (run / MODEL).exists())


def require_same_dataset(run: Path, record: RunRecord, data: Path, dataset: Mapping[str, Any]) -> None:
    """Raise `InvalidInput` if `dataset`, the identity of the one in `data`, isn't that of the run."""
    differ = differences(record.dataset, dataset)
    if differ:
        expected = f"the dataset of the run in {run}, {record.data} or a copy"
        problem = f"{data}, which differs in {', '.join(differ)}: train on it in a new folder"
        raise InvalidInput("data", expected, problem)


def write_config(run: Path, config: TrainConfig) -> None:
    """Write `config.json`, atomically."""
    write_text(run / CONFIG, json.dumps(config.to_dict(), indent=2) + "\n")

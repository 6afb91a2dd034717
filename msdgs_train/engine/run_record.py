"""The folder of a run: the names of its files, its settings, and `run.json`, which names its dataset and best model."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

from msdgs_serve.scene.errors import InvalidInput, MsdgsError
from msdgs_serve.scene.similarity import IDENTITY, Similarity
from msdgs_train.datasets.common.files import write_text
from msdgs_train.engine.config import TrainConfig

CONFIG = "config.json"
RECORD = "run.json"
CHECKPOINT = "checkpoint.pt"
MODEL = "model.pt"
BEST = "best.pt"
FINAL_METRICS = "metrics.json"
LOCK = ".lock"


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
    scene_to_world: Similarity = IDENTITY  # the frame that is trained in


def read_record(run: Path) -> RunRecord | None:
    """Read the contents of `run.json`, None if there is no such file. Raises `RunInvalid`."""
    path = run / RECORD
    if not path.exists():
        return None
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        best = Best(**values["best"]) if values["best"] else None
        frame = values.get("scene_to_world")  # missing in runs that were started in the frame of the files
        return RunRecord(Path(values["data"]), best, IDENTITY if frame is None else Similarity.from_plain(frame))
    except (ValueError, KeyError, TypeError) as error:
        raise RunInvalid(path, f"isn't the record of a run: {error}") from None


def write_record(run: Path, record: RunRecord) -> None:
    """Write `run.json`, atomically."""
    values = {
        "data": str(record.data),
        "best": asdict(record.best) if record.best else None,
        "scene_to_world": record.scene_to_world.to_plain(),
    }
    write_text(run / RECORD, json.dumps(values, indent=2) + "\n")


def read_config(run: Path) -> TrainConfig:
    """Read the settings of a run. Raises `RunInvalid` if there are none, or those of another version."""
    path = run / CONFIG
    try:
        return TrainConfig.from_dict(json.loads(path.read_text(encoding="utf-8")))
    except OSError as error:
        problem = f"{error.strerror}; RUN must be the folder of a run of `msdgs-train fit DATA RUN`"
        raise RunInvalid(path, problem) from None
    except (InvalidInput, ValueError, AttributeError, TypeError) as error:
        raise RunInvalid(path, f"isn't usable in this version, train again in a new folder: {error}") from error


def stored_config(run: Path) -> TrainConfig:
    """Return the settings of a run that can be resumed. Raises `InvalidInput` if there is none, and `RunInvalid`."""
    if not (run / CONFIG).exists() or not (run / CHECKPOINT).exists():
        raise InvalidInput("run", "the folder of a run with a checkpoint, to resume it", run)
    return read_config(run)


def write_config(run: Path, config: TrainConfig) -> None:
    """Write `config.json`, atomically."""
    write_text(run / CONFIG, json.dumps(config.to_dict(), indent=2) + "\n")

"""`run.json`: what a run has to remember besides its settings, where its images are and which model was best."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

from msdgs_serve.scene.errors import MsdgsError
from msdgs_train.datasets.common.files import write_text

RECORD = "run.json"


class RunInvalid(MsdgsError):
    """The folder of a run lacks something, or holds what can't be read; the message names the file."""

    def __init__(self, file: Path, problem: str) -> None:
        super().__init__(f"{file}: {problem}")


@dataclass(frozen=True)
class Best:
    """Which model `best.pt` is: that of the highest mean PSNR so far."""

    split: str  # the held-out images that it was chosen by
    step: int
    psnr: float  # dB


@dataclass(frozen=True)
class RunRecord:
    """The contents of `run.json`."""

    data: Path  # absolute
    best: Best | None = None


def read_record(run: Path) -> RunRecord | None:
    """What a run remembers; None for a run from before there was a `run.json`. Raises `RunInvalid`."""
    path = run / RECORD
    if not path.exists():
        return None
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        return RunRecord(Path(values["data"]), Best(**values["best"]) if values["best"] else None)
    except (ValueError, KeyError, TypeError) as error:
        raise RunInvalid(path, f"isn't the record of a run: {error}") from None


def write_record(run: Path, record: RunRecord) -> None:
    """Atomically."""
    values = {"data": str(record.data), "best": asdict(record.best) if record.best else None}
    write_text(run / RECORD, json.dumps(values, indent=2) + "\n")

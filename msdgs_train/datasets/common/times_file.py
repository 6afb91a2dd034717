"""`times.json`: times of a dataset's images, for layouts whose own files have none.

```
{"unit": "seconds", "times": {"images/00012.png": 0.4, "images/00015.png": 0.5}}
```

Names are relative to the dataset's folder.
"""

import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path

from msdgs_serve.writing import write_text
from msdgs_train.datasets.common.paths import find_file, posix
from msdgs_train.datasets.common.readers import JsonObject, read_json
from msdgs_train.datasets.common.scene_data import Frame

TIMES_FILE = "times.json"


def write_times(folder: Path, times: Mapping[str, float]) -> None:
    """Write the time of each image in seconds, by its path relative to the dataset's folder. Raises `WriteFailed`."""
    write_text(folder / TIMES_FILE, json.dumps({"unit": "seconds", "times": dict(times)}, indent=1) + "\n")


def with_stored_times(frames: Iterable[Frame], folder: Path) -> list[Frame]:
    """The frames with the times of the file; as they are if there is no file.

    Raises `DatasetInvalid` if the file can't be read or has no time for one of the images.
    """
    if not (folder / TIMES_FILE).is_file():
        return list(frames)
    content = read_json(folder / TIMES_FILE)
    if (unit := content.required("unit")) != "seconds":
        raise content.invalid("unit", f"must be seconds, got {unit!r}")
    stored = content.child("times")
    times = {_absolute(find_file(folder, name) or folder / posix(name)): stored.number(name) for name in stored.values}
    return [replace(frame, t=_time(frame, times, stored)) for frame in frames]


def _time(frame: Frame, times: Mapping[str, float], stored: JsonObject) -> float:
    time = times.get(_absolute(frame.image_path))
    if time is None:
        name = Path(os.path.relpath(frame.image_path, stored.file.parent)).as_posix()
        raise stored.invalid(name, "is missing, the time of this image in seconds: add it, or remove the file")
    return time


def _absolute(path: Path) -> str:
    return os.path.abspath(path)

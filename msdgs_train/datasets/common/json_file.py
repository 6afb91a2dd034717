"""JSON files that hold one object."""

import json
from pathlib import Path
from typing import Any

from msdgs_train.datasets.common.scene_data import DatasetInvalid


def read_json(file: Path) -> dict[str, Any]:
    """The object in a file. Raises `DatasetInvalid` where there is none."""
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise DatasetInvalid(file, "file", f"can't be read: {error.strerror}") from None
    except (ValueError, RecursionError) as error:
        raise DatasetInvalid(file, "file", f"is not JSON: {error}") from None
    if not isinstance(content, dict):
        raise DatasetInvalid(file, "file", "must hold a JSON object")
    return content

"""The exporter's report beside a scene file: error against run time of the plans for the scene."""

from pathlib import Path
from typing import Any

from msdgs_serve.scene import SceneFileInvalid
from msdgs_serve.scene.plain_json import parse

SUFFIX = ".report.json"
FORMAT = "msdgs-report/1"
MAX_BYTES = 4 << 20


def report_path(scene_file: Path) -> Path:
    """Return the path of a scene's report, which may not exist."""
    return scene_file.with_suffix(SUFFIX)


def read_report(scene_file: Path, checkpoint_sha256: str) -> dict[str, Any] | None:
    """Return the report beside `scene_file`, or None if there is none or it belongs to another model.

    Raises `SceneFileInvalid` for a file that isn't a report.
    """
    path = report_path(scene_file)
    try:
        with path.open("rb") as file:
            text = file.read(MAX_BYTES + 1)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise SceneFileInvalid(path.name, "report", f"can't be read: {error.strerror}") from None
    try:
        report = parse(text.decode(), MAX_BYTES)
    except ValueError:
        report = None
    if not isinstance(report, dict) or report.get("format") != FORMAT:
        raise SceneFileInvalid(path.name, "report", f"must be a report, {FORMAT}, of at most {MAX_BYTES} bytes")
    return report if report.get("checkpoint_sha256") == checkpoint_sha256 else None

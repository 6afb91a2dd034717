"""The exporter's report beside a scene file: error against run time of the plans for the scene."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from msdgs_serve.scene import SceneFileInvalid
from msdgs_serve.scene.metadata import SceneMetadata
from msdgs_serve.scene.plain_json import parse

SUFFIX = ".report.json"
FORMAT = "msdgs-report/1"
MAX_BYTES = 4 << 20


def read_report(scene_file: Path, metadata: SceneMetadata) -> dict[str, Any] | None:
    """Return the report beside `scene_file`, whose metadata are given, or None if there is none or it is of another
    file: of another model, or with another plan or error than that of its chosen point.

    Raises `SceneFileInvalid` for a file that isn't a report.
    """
    path = scene_file.with_suffix(SUFFIX)
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
    return report if _is_of(report, metadata) else None


def has_report(scene_file: Path, metadata: SceneMetadata) -> bool:
    """Whether `read_report` returns a report."""
    try:
        return read_report(scene_file, metadata) is not None
    except SceneFileInvalid:
        return False


def _is_of(report: Mapping[str, Any], metadata: SceneMetadata) -> bool:
    try:
        chosen = next(point for point in report["points"] if point["chosen"])
        found = report["checkpoint_sha256"], chosen["plan"], chosen["error"]
    except (LookupError, TypeError, StopIteration):
        return False
    return found == (metadata.checkpoint_sha256, metadata.plan, metadata.measured_error.get("rendered"))

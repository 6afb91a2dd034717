"""A checkpoint in, a proven scene file out."""

import hashlib
import json
import math
import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import onnx
from onnx import helper

from export.bake import bake
from export.plans import build
from export.precision.assess import assess
from export.verify import TIMES, TOLERANCE, verify
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.scene.baked import SceneMetadata
from msdgs_train.checkpoint import load_model
from msdgs_train.model import DynamicGaussians

PLAN = "network"
STABILITY_TIMES = 8


@dataclass(frozen=True)
class Exported:
    """What was written."""

    path: Path
    size: int  # bytes
    moving_count: int
    static_count: int
    metadata: SceneMetadata

    @property
    def measured_error(self) -> dict[str, Any]:
        return self.metadata.measured_error


def export_scene(
    checkpoint: Path,
    output: Path,
    *,
    tolerance: float = TOLERANCE,
    times: int = TIMES,
    on_time: Callable[[], object] = lambda: None,
) -> Exported:
    """Bake `checkpoint`, write it beside `output`, compare that file with the model, and only then move it there.

    Whatever goes wrong before, `output` stays as it was. Raises `CheckpointInvalid`, `ModelNotExportable`,
    `PlanUnsafe`, `VerificationFailed`, or `SceneFileInvalid` where the written file breaks its contract.
    """
    loaded = load_model(checkpoint)
    with checkpoint.open("rb") as file:
        sha256 = hashlib.file_digest(file, "sha256").hexdigest()
    baked = bake(loaded.model, loaded.scene, sha256)
    assess(loaded.model, loaded.scene, times=STABILITY_TIMES).require(PLAN)
    return write_scene(output, build(PLAN, baked), loaded.model, tolerance=tolerance, times=times, on_time=on_time)


def write_scene(
    output: Path,
    contents: onnx.ModelProto,
    model: DynamicGaussians,
    *,
    rendered: dict[str, Any] | None = None,
    tolerance: float = TOLERANCE,
    times: int = TIMES,
    on_time: Callable[[], object] = lambda: None,
) -> Exported:
    """Write a scene file beside `output`, compare it with the model of its moving part, and only then move it there.

    `rendered` is what is known of its frames, and goes into its metadata. With it, a plan that computes something
    else than the model's own layers isn't held to `tolerance`: its frames have been judged.
    """
    exact = rendered is None or properties(contents)["plan"] == PLAN
    with _beside(output) as temporary:
        _write(temporary, contents)
        session, allowed = DeformationSession(temporary), tolerance if exact else math.inf
        measured = verify(session, model, times=times, tolerance=allowed, on_time=on_time)
        measured = properties(contents)["measured_error"] | measured  # what a fitted plan knows of itself stays
        if rendered is not None:
            measured |= {"rendered": rendered}
        helper.set_model_props(contents, _as_texts(properties(contents) | {"measured_error": measured}))
        _write(temporary, contents)
        scene = DeformationSession(temporary).scene  # only its metadata is new, and it must be whole like the first
        os.replace(temporary, output)
    return Exported(output, output.stat().st_size, scene.moving_count, scene.static_count, scene.metadata)


def properties(contents: onnx.ModelProto) -> dict[str, Any]:
    """The metadata of a scene file, plain values by name."""
    return {entry.key: json.loads(entry.value) for entry in contents.metadata_props}


def _as_texts(values: dict[str, Any]) -> dict[str, str]:
    return {name: json.dumps(value, allow_nan=False) for name, value in values.items()}


@contextmanager
def _beside(output: Path) -> Iterator[Path]:
    """A new file in the same folder; gone at the end unless it was moved away."""
    handle, name = tempfile.mkstemp(dir=output.parent, prefix=f".{output.stem}.", suffix=".onnx.tmp")
    os.fchmod(handle, 0o644) if hasattr(os, "fchmod") else None
    os.close(handle)
    try:
        yield Path(name)
    finally:
        Path(name).unlink(missing_ok=True)


def _write(path: Path, contents: onnx.ModelProto) -> None:
    with path.open("wb") as file:
        file.write(contents.SerializeToString())
        file.flush()
        os.fsync(file.fileno())

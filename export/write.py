"""A checkpoint in, a proven scene file out."""

import hashlib
import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from export.bake import Baked, bake
from export.plans import build
from export.precision.assess import assess
from export.verify import TIMES, TOLERANCE, verify
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.scene.baked import SceneMetadata
from msdgs_train.checkpoint import load_model

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
    with _beside(output) as temporary:
        _write(temporary, baked)
        measured = verify(
            DeformationSession(temporary), loaded.model, times=times, tolerance=tolerance, on_time=on_time
        )
        _write(temporary, _with_measured_error(baked, measured))
        scene = DeformationSession(temporary).scene  # only its metadata is new, and it must be whole like the first
        os.replace(temporary, output)
    return Exported(output, output.stat().st_size, scene.moving_count, scene.static_count, scene.metadata)


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


def _write(path: Path, baked: Baked) -> None:
    with path.open("wb") as file:
        file.write(build(PLAN, baked).SerializeToString())
        file.flush()
        os.fsync(file.fileno())


def _with_measured_error(baked: Baked, measured: dict[str, Any]) -> Baked:
    metadata = replace(baked.scene.metadata, measured_error=measured)
    return replace(baked, scene=replace(baked.scene, metadata=metadata))

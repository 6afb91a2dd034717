"""Writing and verifying a scene file."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import onnx
from onnx import helper

from msdgs_export.jobs.verify import TIMES, TOLERANCE, differences, verify
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.scene.baked import BakedScene, SceneMetadata
from msdgs_serve.writing import replacing
from msdgs_train.gaussians.model import DynamicGaussians


@dataclass(frozen=True)
class Exported:
    """A scene file that was written."""

    path: Path
    size: int  # bytes
    moving_count: int
    static_count: int
    metadata: SceneMetadata

    @property
    def measured_error(self) -> dict[str, Any]:
        return self.metadata.measured_error


def write_scene(
    output: Path,
    contents: onnx.ModelProto,
    model: DynamicGaussians,
    *,
    packed: onnx.ModelProto | None = None,
    rendered: dict[str, Any] | None = None,
    tolerance: float = TOLERANCE,
    times: int = TIMES,
    on_time: Callable[[], object] = lambda: None,
) -> Exported:
    """Write a scene file that is compared with the model of its moving part, or in its place the same with packed
    arrays, of which only the difference is measured.

    `rendered` is the error of frames of what is written, which is stored in its metadata.
    """

    def measured(session: DeformationSession) -> dict[str, Any]:
        errors = verify(session, model, times=times, tolerance=tolerance, on_time=on_time)
        if packed is not None:
            errors["storage"] = storage_differences(output, packed, session)
        return errors if rendered is None else {**errors, "rendered": rendered}

    scene = write_measured(output, contents, measured, packed)
    return Exported(output, output.stat().st_size, scene.moving_count, scene.static_count, scene.metadata)


def storage_differences(output: Path, packed: onnx.ModelProto, exact: DeformationSession) -> dict[str, float]:
    """The largest differences that packed arrays make, by output."""
    return differences(DeformationSession(output, contents=packed.SerializeToString()), exact)


def write_measured(
    output: Path,
    contents: onnx.ModelProto,
    measure: Callable[[DeformationSession], dict[str, Any]],
    packed: onnx.ModelProto | None = None,
) -> BakedScene:
    """Write a scene file beside `output`, add what `measure` finds to its `measured_error`, and only then move it
    there, or the file with packed arrays."""
    with replacing(output) as temporary:
        temporary.write_bytes(contents.SerializeToString())
        measured = measure(DeformationSession(temporary))
        written = contents if packed is None else packed
        set_properties(written, measured_error=properties(contents)["measured_error"] | measured)
        temporary.write_bytes(written.SerializeToString())
        return DeformationSession(temporary).scene  # opened again: its metadata has changed


def properties(contents: onnx.ModelProto) -> dict[str, Any]:
    """The metadata of a scene file as plain values by name."""
    return {entry.key: json.loads(entry.value) for entry in contents.metadata_props}


def set_properties(contents: onnx.ModelProto, **changes: Any) -> None:
    """Change metadata of a scene file."""
    values = properties(contents) | changes
    helper.set_model_props(contents, {name: json.dumps(value, allow_nan=False) for name, value in values.items()})

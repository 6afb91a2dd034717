"""Writing and verifying a scene file."""

import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import onnx
from onnx import helper

from export.measure.verify import TIMES, TOLERANCE, verify
from export.plans.base import BASELINE
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.scene.baked import SceneMetadata
from msdgs_train.datasets.common.files import replacing
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
    rendered: dict[str, Any] | None = None,
    tolerance: float = TOLERANCE,
    times: int = TIMES,
    on_time: Callable[[], object] = lambda: None,
) -> Exported:
    """Write a scene file beside `output`, compare it with the model of its moving part, and only then move it there.

    `rendered` is the error of its frames, which is stored in its metadata. With it, a plan other than `network` isn't
    held to `tolerance`: its frames have been compared.
    """
    exact = rendered is None or properties(contents)["plan"] == BASELINE
    with replacing(output) as temporary:
        temporary.write_bytes(contents.SerializeToString())
        session, allowed = DeformationSession(temporary), tolerance if exact else math.inf
        measured = verify(session, model, times=times, tolerance=allowed, on_time=on_time)
        measured = properties(contents)["measured_error"] | measured  # keeps the error bound of a fitted plan
        if rendered is not None:
            measured |= {"rendered": rendered}
        set_properties(contents, measured_error=measured)
        temporary.write_bytes(contents.SerializeToString())
        scene = DeformationSession(temporary).scene  # opened again: its metadata has changed
    return Exported(output, output.stat().st_size, scene.moving_count, scene.static_count, scene.metadata)


def properties(contents: onnx.ModelProto) -> dict[str, Any]:
    """The metadata of a scene file as plain values by name."""
    return {entry.key: json.loads(entry.value) for entry in contents.metadata_props}


def set_properties(contents: onnx.ModelProto, **changes: Any) -> None:
    """Change metadata of a scene file."""
    values = properties(contents) | changes
    helper.set_model_props(contents, {name: json.dumps(value, allow_nan=False) for name, value in values.items()})

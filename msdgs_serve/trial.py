"""Open and pose a scene file in a subprocess, before the service opens it.

`read_scene_file` rejects all graphs at which onnxruntime is known to crash. If it crashes at another, that ends the
subprocess and not the service.
"""

import json
import tempfile
from pathlib import Path
from typing import Any, BinaryIO

from msdgs_serve.deformation import DeformationSession
from msdgs_serve.guarded import ProcessFailed, ProcessLimits, call_guarded
from msdgs_serve.scene import SceneFileInvalid
from msdgs_serve.scene.onnx import GraphLimits

MEMORY, MEMORY_PER_BYTE = 1 << 29, 6
"""Memory limit of the subprocess in bytes: its own, and per byte of the file; the graph's limit is added."""

MAX_ANSWER = 1 << 16
"""Bytes that the subprocess returns."""


def try_scene(file: Path, limits: GraphLimits, seconds: float) -> None:
    """Open `file` in a subprocess and pose its Gaussians at both ends and in the middle of its time range, within
    `seconds`.

    Raises `SceneFileInvalid` with the subprocess's reason, or because it crashed or took too long.
    """
    memory = MEMORY + MEMORY_PER_BYTE * file.stat().st_size + limits.memory_bytes
    with tempfile.TemporaryFile() as answer:
        try:
            process_limits = ProcessLimits(memory, MAX_ANSWER, seconds)
            call_guarded(open_and_pose, str(file), vars(limits), limits=process_limits, answer=answer)
        except ProcessFailed as error:
            raise SceneFileInvalid(file.name, "file", str(error)) from None
        problem = json.load(answer)
    if problem:
        raise SceneFileInvalid(file.name, **problem)


def open_and_pose(answer: BinaryIO, file: str, limits: dict[str, Any]) -> None:
    """Run in the subprocess: write the problem of the file as a JSON object, which is empty if there is none."""
    problem = {}
    try:
        session = DeformationSession(file, limits=GraphLimits(**limits))
        t0, t1 = session.scene.metadata.time_range
        for t in (t0, (t0 + t1) / 2, t1):
            session.pose(t)
    except SceneFileInvalid as error:
        problem = {"field": error.field, "problem": error.problem, "details": error.details}
    answer.write(json.dumps(problem).encode())

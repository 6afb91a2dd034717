"""A scene file opened and posed in a process of its own, before a service opens it.

`read_scene_file` lets nothing through that onnxruntime is known to fail at. What it fails at all the same costs that
process, and not the service.
"""

import json
import tempfile
from pathlib import Path
from typing import Any, BinaryIO

from msdgs_serve.deformation import DeformationSession
from msdgs_serve.guarded import ProcessFailed, ProcessLimits, call_guarded
from msdgs_serve.scene import SceneFileInvalid
from msdgs_serve.scene.onnx import GraphLimits

MEMORY, MEMORY_A_BYTE = 1 << 29, 6
"""Bytes that the process may have: its own, and for each byte of the file, besides those of a call of the graph."""

MAX_ANSWER = 1 << 16
"""Bytes."""


def try_scene(file: Path, limits: GraphLimits, seconds: float) -> None:
    """Open `file` and pose its Gaussians in the middle of its time, in at most so many seconds.

    Raises `SceneFileInvalid` with what that process says, or that it didn't end well.
    """
    memory = MEMORY + MEMORY_A_BYTE * file.stat().st_size + limits.memory_bytes
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
    """Write what is wrong with the file as an object, an empty one if nothing is."""
    problem = {}
    try:
        session = DeformationSession(file, limits=GraphLimits(**limits))
        session.pose(sum(session.scene.metadata.time_range) / 2)
    except SceneFileInvalid as error:
        problem = {"field": error.field, "problem": error.problem, "details": error.details}
    answer.write(json.dumps(problem).encode())

"""Open and pose a scene file in a subprocess with limits on memory and time, before the service opens it.

`read_scene_file` rejects all graphs at which onnxruntime is known to crash. If it crashes at another, that ends the
subprocess and not the service.
"""

import contextlib
import json
import os
import resource
import subprocess
import sys
from pathlib import Path

from msdgs_serve.deformation import DeformationSession
from msdgs_serve.scene import SceneFileInvalid
from msdgs_serve.scene.onnx import GraphLimits
from msdgs_serve.threads import THREADS_VARIABLE

MEMORY, MEMORY_PER_BYTE = 1 << 29, 6
"""Memory limit of the subprocess in bytes: its own, and per byte of the file; the graph's limit is added."""

OPEN_FILES = 64
NICENESS = 10


def try_scene(file: Path, limits: GraphLimits, seconds: float) -> None:
    """Open `file` in a subprocess and pose its Gaussians in the middle of its time range, within `seconds`.

    Raises `SceneFileInvalid` with the subprocess's reason, or because it crashed or took too long.
    """
    memory = MEMORY + MEMORY_PER_BYTE * file.stat().st_size + limits.memory_bytes
    given = json.dumps({"file": str(file), "limits": vars(limits), "memory": memory, "seconds": seconds})
    command = [sys.executable, "-P", "-m", "msdgs_serve.trial", given]
    environment = {**os.environ, THREADS_VARIABLE: "1", "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    try:
        done = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, timeout=seconds, check=False, env=environment
        )
    except subprocess.TimeoutExpired:
        raise SceneFileInvalid(file.name, "file", f"isn't opened and posed within {seconds:g} s") from None
    try:
        answer = json.loads(done.stdout) if done.returncode == 0 else None
    except ValueError:
        answer = None
    if answer is None:
        problem = f"crashes the process that tests it ({done.returncode}), within a limit of {memory >> 20:,} MiB"
        raise SceneFileInvalid(file.name, "file", problem)
    if answer:
        raise SceneFileInvalid(file.name, **answer)


def main(given: str) -> None:
    """Run in the subprocess: print the problem of the file as a JSON object, which is empty if there is none."""
    asked = json.loads(given)
    _limit(asked["memory"], asked["seconds"])
    answer = {}
    try:
        session = DeformationSession(asked["file"], limits=GraphLimits(**asked["limits"]))
        session.pose(sum(session.scene.metadata.time_range) / 2)
    except SceneFileInvalid as error:
        answer = {"field": error.field, "problem": error.problem, "details": error.details}
    print(json.dumps(answer))


def _limit(memory: int, seconds: float) -> None:
    os.nice(NICENESS)
    with contextlib.suppress(OSError):  # if Linux runs out of memory, it kills this process first
        Path("/proc/self/oom_score_adj").write_text("1000")
    limits = {
        resource.RLIMIT_CPU: int(seconds) + 1,
        resource.RLIMIT_FSIZE: 0,
        resource.RLIMIT_CORE: 0,
        resource.RLIMIT_NOFILE: OPEN_FILES,
    }
    if sys.platform == "linux":  # other systems don't enforce it
        limits[resource.RLIMIT_DATA] = memory
    for which, limit in limits.items():
        _, maximum = resource.getrlimit(which)
        limit = limit if maximum == resource.RLIM_INFINITY else min(limit, maximum)
        resource.setrlimit(which, (limit, limit))


if __name__ == "__main__":
    main(sys.argv[1])

"""A function called in a process of its own, with limits of memory, time and what it writes.

Native code that reads the files of others may crash, hang or take all memory. This costs that process, not its caller.
"""

import contextlib
import importlib
import json
import os
import resource
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from msdgs_serve.threads import NICENESS, THREADS_VARIABLE

OPEN_FILES = 64


class ProcessLimits(NamedTuple):
    """Of one call."""

    memory: int  # bytes of data, those of the interpreter and of libraries among them
    written: int  # bytes of each file that it writes, its answer among them
    seconds: float


class ProcessFailed(Exception):
    """The process ended without an answer; says how."""


def call_guarded(function: Callable[..., None], *arguments: Any, limits: ProcessLimits, answer: BinaryIO) -> None:
    """Call a module's `function` with the file for its answer and these arguments, which JSON can hold.

    `answer` is an open file of the system, rewound at the end. Raises `ProcessFailed` where the function raises, too.
    """
    call = {"module": function.__module__, "name": function.__name__, "arguments": arguments, "limits": limits}
    command = [sys.executable, "-P", "-m", "msdgs_serve.guarded", json.dumps(call)]
    environment = {**os.environ, THREADS_VARIABLE: "1", "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    nowhere = subprocess.DEVNULL
    try:
        done = subprocess.run(
            command, stdin=nowhere, stdout=answer, stderr=nowhere, timeout=limits.seconds, check=False, env=environment
        )
    except subprocess.TimeoutExpired:
        raise ProcessFailed(f"isn't read within {limits.seconds:g} s") from None
    if done.returncode:
        problem = (
            f"crashes the process that reads it ({done.returncode}), within a limit of {limits.memory >> 20:,} MiB"
        )
        raise ProcessFailed(problem)
    answer.seek(0)


def main(text: str) -> None:
    """Make the call, in the process."""
    call = json.loads(text)
    _limit(ProcessLimits(*call["limits"]))
    with os.fdopen(os.dup(1), "wb") as answer:
        os.dup2(2, 1)  # what libraries print is no part of it
        getattr(importlib.import_module(call["module"]), call["name"])(answer, *call["arguments"])


def _limit(limits: ProcessLimits) -> None:
    os.nice(NICENESS)
    with contextlib.suppress(OSError):  # where Linux runs out of memory, this is the process to end
        Path("/proc/self/oom_score_adj").write_text("1000")
    values = {
        resource.RLIMIT_CPU: int(limits.seconds) + 1,
        resource.RLIMIT_FSIZE: limits.written,
        resource.RLIMIT_CORE: 0,
        resource.RLIMIT_NOFILE: OPEN_FILES,
    }
    if sys.platform == "linux":  # elsewhere the system doesn't keep to it
        values[resource.RLIMIT_DATA] = limits.memory
    for which, value in values.items():
        _, most = resource.getrlimit(which)
        value = value if most == resource.RLIM_INFINITY else min(value, most)
        resource.setrlimit(which, (value, value))


if __name__ == "__main__":
    main(sys.argv[1])

"""Call a function in a subprocess with limits on memory, time and output.

Native code that reads untrusted files may crash, hang or exhaust memory; this ends the subprocess, not its caller.
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
    """Limits of one call."""

    memory: int  # bytes of data, interpreter and libraries included
    written: int  # bytes per written file, the answer included
    seconds: float


class ProcessFailed(Exception):
    """The process ended without an answer; the message names the cause."""


def call_guarded(function: Callable[..., None], *arguments: Any, limits: ProcessLimits, answer: BinaryIO) -> None:
    """Call a module's `function` with a file for its answer and arguments that JSON can hold.

    `answer` is an open file with a descriptor, rewound at the end. Raises `ProcessFailed`, also if the function raises.
    """
    call = {"module": function.__module__, "name": function.__name__, "arguments": arguments, "limits": limits}
    command = [sys.executable, "-P", "-m", "msdgs_serve.guarded", json.dumps(call)]
    environment = {**os.environ, THREADS_VARIABLE: "1", "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    try:
        done = subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            stdout=answer,
            stderr=subprocess.DEVNULL,
            timeout=limits.seconds,
            check=False,
            env=environment,
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
    """Make the call in the subprocess."""
    call = json.loads(text)
    _limit(ProcessLimits(*call["limits"]))
    with os.fdopen(os.dup(1), "wb") as answer:
        os.dup2(2, 1)  # output of libraries is not part of the answer
        getattr(importlib.import_module(call["module"]), call["name"])(answer, *call["arguments"])


def _limit(limits: ProcessLimits) -> None:
    os.nice(NICENESS)
    with contextlib.suppress(OSError):  # if Linux runs out of memory, it ends this process first
        Path("/proc/self/oom_score_adj").write_text("1000")
    values = {
        resource.RLIMIT_CPU: int(limits.seconds) + 1,
        resource.RLIMIT_FSIZE: limits.written,
        resource.RLIMIT_CORE: 0,
        resource.RLIMIT_NOFILE: OPEN_FILES,
    }
    if sys.platform == "linux":  # other systems don't enforce it
        values[resource.RLIMIT_DATA] = limits.memory
    for which, value in values.items():
        _, hard = resource.getrlimit(which)
        value = value if hard == resource.RLIM_INFINITY else min(value, hard)
        resource.setrlimit(which, (value, value))


if __name__ == "__main__":
    main(sys.argv[1])

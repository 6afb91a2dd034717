"""Lines of progress that the process of `sfm_process` writes to its standard output."""

import json
import os
from typing import TextIO

_output: list[TextIO] = []


def start_reports() -> None:
    """Write reports to the standard output; what libraries print there goes to the standard error from now on."""
    _output.append(os.fdopen(os.dup(1), "w"))
    os.dup2(2, 1)


def report(stage: str, done: int, total: int) -> None:
    """Write a line of progress."""
    for output in _output:
        output.write(json.dumps([stage, done, total]) + "\n")
        output.flush()

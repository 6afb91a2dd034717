"""Work for the tests on a Ray cluster, in a module that its workers can import."""

import os
from pathlib import Path

from msdgs_serve.scene import InvalidInput


def dies_once(folder: Path, number: int) -> int:
    """Its worker, the first time that the marked item is worked on."""
    marker = folder / "died"
    if number == 3 and not marker.exists():
        marker.touch()
        os._exit(1)
    return number * number


def always_dies(number: int) -> int:
    os._exit(number)


def refuses(number: int) -> int:
    raise InvalidInput("number", "another", number)

"""Errors of imports."""

from pathlib import Path

from msdgs_serve.scene.errors import MsdgsError

AS_PLY = "write it as a PLY with the program that made it"
"""What to do with a file of a version that isn't read."""


class ImportFailed(MsdgsError):
    """A file or folder can't be read as its format."""

    def __init__(self, file: str | Path, problem: str) -> None:
        super().__init__(f"{file}: {problem}")
        self.file = Path(file)
        self.problem = problem


def cut_off(file: str | Path, part: str, needed: int, found: int) -> ImportFailed:
    """A file that is shorter than its header states."""
    return ImportFailed(file, f"is cut off: {part} needs {needed:,} bytes, there are {found:,}")

"""Errors of a capture."""

from pathlib import Path

from msdgs_serve.scene.errors import MsdgsError


class CaptureFailed(MsdgsError, ValueError):
    """A recording that no dataset can be made of; the message names the file, what is wrong with it and what to do."""

    def __init__(self, file: Path | str, problem: str) -> None:
        super().__init__(f"{file}: {problem}")
        self.file, self.problem = file, problem

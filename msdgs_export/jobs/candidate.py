"""Scene files that may be chosen as the export, and those that can't be made or drawn."""

import hashlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from msdgs_export.measure.rendered_error import RenderedError
from msdgs_export.pruning import PrunedModel
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.scene.errors import InvalidInput, SceneFileInvalid

UNUSABLE = (InvalidInput, SceneFileInvalid)
"""Errors of a file whose poses can't be drawn: rounded to fewer bits, or overflowing in float32."""

Result = TypeVar("Result")


@dataclass(frozen=True, eq=False)
class Candidate:
    """A scene file that may be chosen as the export, and how it was made."""

    plan: str
    pruning_db: float | None  # dB, lowest PSNR of a frame that pruning alone may cause; None: not pruned
    pruned: PrunedModel
    path: Path
    float32: Path | None = None  # the same in float32, if the arrays of this file are packed

    @cached_property
    def session(self) -> DeformationSession:
        """The file, opened on first use."""
        return DeformationSession(self.path)

    @cached_property
    def digest(self) -> bytes:
        """SHA-256 of the file."""
        return hashlib.sha256(self.path.read_bytes()).digest()

    def close(self) -> None:
        """Release the memory of the open file."""
        self.__dict__.pop("session", None)

    @property
    def sh_degree(self) -> int:
        """SH degree of its colors."""
        return self.pruned.moving.config.sh_degree

    @property
    def size(self) -> int:
        """Size of the file in bytes."""
        return self.path.stat().st_size

    def to_plain(self) -> dict[str, Any]:
        """The keys that identify it in a report."""
        return {"plan": self.plan, "pruning_db": self.pruning_db, "sh_degree": self.sh_degree}


class Measured(NamedTuple):
    """A candidate, and the error of its frames."""

    candidate: Candidate
    error: RenderedError


def usable(
    candidates: Iterable[Candidate],
    measure: Callable[[Candidate], Result],
    refused: list[tuple[str, str]],
) -> Iterator[Result]:
    """What `measure` returns for each candidate; those that can't be drawn are added to `refused`, by plan and why.

    Raises `InvalidInput` if no other is left.
    """
    none = True
    for candidate in candidates:
        try:
            measured = measure(candidate)
        except UNUSABLE as error:  # its motion overflows in float32 at a time that no estimate has tried
            refused.append((candidate.plan, str(error)))
        else:
            none = False
            yield measured
    if none:
        raise nothing_left(refused)


def nothing_left(refused: Sequence[tuple[str, str]]) -> InvalidInput:
    """The error of a model of which all plans were refused."""
    return InvalidInput("model", "one that some plan can hold", "; ".join(why for _, why in refused))

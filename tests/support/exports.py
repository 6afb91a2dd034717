"""The parts of an export, put together as `msdgs-export` does."""

from collections.abc import Collection
from pathlib import Path
from typing import Any, NamedTuple

from msdgs_export.jobs.builder import CandidateBuilder
from msdgs_export.jobs.checkpoint import Checkpoint
from msdgs_export.jobs.ruler import Ruler
from msdgs_export.jobs.sweep import Sweep, SweepResult
from msdgs_export.pruning import RULES
from msdgs_export.target import Target
from msdgs_train.gaussians.model import DynamicGaussians


class Parts(NamedTuple):
    """The parts of one export."""

    checkpoint: Checkpoint
    builder: CandidateBuilder
    ruler: Ruler
    target: Target

    @property
    def model(self) -> DynamicGaussians:
        """The model, along a Z-order curve."""
        return self.checkpoint.model

    def sweep(self) -> SweepResult:
        """A sweep over all candidates."""
        return Sweep(self.builder, self.ruler, self.target).run()


def parts_of(
    file: Path, folder: Path, target: Target | None = None, rules: Collection[str] = tuple(RULES), images: Any = None
) -> Parts:
    """The parts of the export of a model.pt, whose candidates are written into `folder`."""
    checkpoint = Checkpoint.load(file)
    ruler, target = Ruler(checkpoint, images), target or Target()
    return Parts(checkpoint, CandidateBuilder.of(checkpoint, ruler, target, folder, rules), ruler, target)

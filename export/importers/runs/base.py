"""What an importer of another trainer's runs provides."""

from pathlib import Path
from typing import Any, Protocol

from msdgs_train.gaussians.canonical import CanonicalGaussians
from msdgs_train.gaussians.model import DynamicGaussians
from msdgs_train.gaussians.model_file import SceneInfo


class Fidelity(Protocol):
    """How far frames of an imported model are from those of the program that trained it."""

    def left_out(self) -> dict[str, Any]:
        """The entry of `left_out` in a scene file."""
        ...

    def note(self) -> str:
        """One sentence for the user of the importer."""
        ...


class RunImporter(Protocol):
    """Reads run folders of one trainer. Register one in `export.importers.runs.model.RUNS` under the format's name."""

    white_background: bool
    """The background of runs whose cfg_args don't name one."""

    def detects(self, run: Path) -> bool:
        """Whether a folder is a run of this trainer."""
        ...

    def read(
        self, run: Path, gaussians: CanonicalGaussians, iteration: int, settings: dict[str, Any]
    ) -> tuple[DynamicGaussians, list[str]]:
        """The model of an iteration, given its canonical Gaussians and cfg_args, and notes for the user.

        Raises `ImportFailed` for networks that are built otherwise.
        """
        ...

    def fidelity(self, model: DynamicGaussians, info: SceneInfo) -> Fidelity | None:
        """The difference that its own renderer makes; None if there is none."""
        ...

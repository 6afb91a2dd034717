"""The interface of an importer of another trainer's runs."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import torch

from msdgs_export.importers.runs.state import RunFolder
from msdgs_train.gaussians.canonical import CanonicalGaussians
from msdgs_train.gaussians.model import DynamicGaussians, ModelConfig
from msdgs_train.gaussians.model_file import SceneInfo


@dataclass(frozen=True)
class Loss:
    """A property of a run's Gaussians that a scene file can't hold, and the PSNR that this costs."""

    rule: str
    what: str
    count: int  # Gaussians
    worst_db: float  # of the worst frame
    note: str  # one sentence for the user

    def left_out(self) -> dict[str, Any]:
        """The entry of `left_out` in a scene file."""
        numbers = {"count": self.count, "of": self.count, "worst_frame_db": self.worst_db}
        return {"rule": self.rule, "what": self.what, **numbers}


class RunImporter(Protocol):
    """Reads run folders of one trainer. Register one in `RUNS` of `runs/model.py` under the format's name."""

    networks: str
    """Path of the networks in a run folder, with `*` for the number of the iteration. It identifies the format."""
    marker: str
    """The name of a tensor that such networks have and others at the same path don't; empty: any are such."""
    white_background: bool
    """Background of runs whose cfg_args don't name one."""

    def read(self, run: RunFolder, gaussians: CanonicalGaussians) -> tuple[DynamicGaussians, list[str]]:
        """The model of a run, given its canonical Gaussians, and notes for the user.

        Raises `ImportFailed` for networks of another structure.
        """
        ...

    def fidelity(self, model: DynamicGaussians, info: SceneInfo) -> Loss | None:
        """The difference between frames of the trainer's own renderer and of this one; None if there is none."""
        ...


def filled_model(
    config: ModelConfig, gaussians: CanonicalGaussians, fill: Callable[[DynamicGaussians], object]
) -> DynamicGaussians:
    """A model whose parameters `fill` sets. It is called without memory first, so that all shapes are checked before
    memory for any of them is allocated."""
    with torch.device("meta"):
        shapes_only = DynamicGaussians(config, gaussians)
    fill(shapes_only)
    model = DynamicGaussians(config, gaussians)
    fill(model)
    return model

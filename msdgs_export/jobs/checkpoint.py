"""The model to export, as its file holds it."""

import hashlib
from dataclasses import dataclass
from pathlib import Path

from msdgs_export.bake import Baked
from msdgs_export.pruning import PrunedModel
from msdgs_export.pruning.mask import bake_pruned, in_spatial_order
from msdgs_train.gaussians.model import DynamicGaussians
from msdgs_train.gaussians.model_file import SceneInfo, load_model


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """A model, with its Gaussians along a Z-order curve, and its scene."""

    model: DynamicGaussians
    info: SceneInfo
    sha256: str  # of the file

    @classmethod
    def load(cls, file: Path) -> "Checkpoint":
        """Read a model.pt. Raises `CheckpointInvalid`."""
        model, info, _ = load_model(file)
        with file.open("rb") as opened:
            return cls(in_spatial_order(model), info, hashlib.file_digest(opened, "sha256").hexdigest())

    def bake(self, pruned: PrunedModel) -> Baked:
        """Bake what pruning left of the model."""
        return bake_pruned(pruned, self.info, self.sha256)

"""`msdgs-train steps`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from msdgs_train.cli.console import console
from msdgs_train.settings import optional


@dataclass(frozen=True)
class Steps:
    """Draw the Gaussians after k = 0, 1, …, K layers of the deformation side by side: the contribution of each layer.

    Example:  msdgs-train steps runs/first/model.pt --t 0.9
    """

    model: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="MODEL")]
    """The model.pt or best.pt of a run."""
    t: Annotated[float | None, optional("TIME")] = None
    """Time in the scene's range; 0.3 of the way through it if not given."""
    out: Path = Path("steps.png")
    """The PNG to write."""
    size: int = 400
    """Width of each image in pixels, height in proportion."""
    camera: Annotated[str | None, optional("NAME")] = None
    """Name of a camera in the model; the one whose image is nearest in time if not given."""

    def execute(self) -> int:
        from msdgs_train.evaluation.layer_strip import write_steps

        images = write_steps(self.model, self.out, t=self.t, size=self.size, camera=self.camera)
        console.print(f"wrote {self.out}: k = 0 to {len(images) - 1}", soft_wrap=True)
        return 0

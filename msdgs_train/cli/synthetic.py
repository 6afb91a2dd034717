"""`msdgs-train synthetic`."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import tyro

from msdgs_train.cli.console import console, frame_progress
from msdgs_train.settings import optional


@dataclass(frozen=True)
class Synthetic:
    """Make a small moving scene with known motion in D-NeRF layout, by ray marching: no download.

    Example:  msdgs-train synthetic data/toy && msdgs-train fit data/toy runs/toy --steps 2000
    """

    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """The folder to create."""
    size: int = 128
    """Width and height of the images in pixels."""
    train_frames: int = 64
    """Training images of each camera, at evenly spaced times."""
    test_frames: int = 12
    """Held-out images, at intermediate times, from one smooth turn around the scene."""
    cameras: Annotated[int | None, optional("INT")] = None
    """Fixed cameras that see each time together; one camera that is elsewhere at each time if not given."""
    seed: int = 0
    """Seed of the camera positions."""

    def execute(self) -> int:
        from msdgs_train.datasets.synthetic.generate import generate

        with frame_progress(self.train_frames * (self.cameras or 1) + self.test_frames) as progress:
            generate(**asdict(self), progress=progress)
        console.print(f"made {self.out}; next: msdgs-train fit {self.out} runs/first", soft_wrap=True)
        return 0

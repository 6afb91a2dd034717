"""`msdgs-train synthetic`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from msdgs_train.cli.console import console, frame_progress


@dataclass(frozen=True)
class Synthetic:
    """Make a small moving scene with known motion, ray-marched into D-NeRF layout. No downloads, a few seconds.

    Example:  msdgs-train synthetic data/toy && msdgs-train fit data/toy runs/toy --steps 2000
    """

    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """The folder to make."""
    size: int = 128
    """Width and height of the images in pixels."""
    train_frames: int = 64
    """At evenly spaced times, from all around."""
    test_frames: int = 12
    """Held out: at times between, from one smooth turn around the scene."""
    seed: int = 0
    """Of the cameras and times."""

    def execute(self) -> int:
        from msdgs_train.datasets.synthetic.generate import generate

        with frame_progress(self.train_frames + self.test_frames) as progress:
            generate(
                self.out,
                size=self.size,
                train_frames=self.train_frames,
                test_frames=self.test_frames,
                seed=self.seed,
                progress=progress,
            )
        console.print(f"made {self.out}; next: msdgs-train fit {self.out} runs/first", soft_wrap=True)
        return 0

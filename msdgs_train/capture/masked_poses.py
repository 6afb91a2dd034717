"""Poses of frames in which something moves, and masks of it, as two steps whose results are kept."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from msdgs_serve.writing import write_text
from msdgs_train.capture.frame_set import FrameSet
from msdgs_train.capture.moving import find_moving
from msdgs_train.capture.poses import Poses, find_poses
from msdgs_train.capture.progress import Progress

POSES, MASKS = "poses", "masks"
"""Names of the steps; that of the second is also the folder of the masks in it."""
MOVING = "moving.json"

Keep = Callable[[str, Callable[[Path, Progress], None]], Path]
"""Makes the result of a step of this name by a function that fills a folder, unless it is there; returns its folder."""


class MaskedPoses(NamedTuple):
    """Poses, and where the frames move."""

    poses: Poses
    masks: Path
    """Folder of a mask of each frame's name, white where it moves, of the frames as they are."""
    moving: dict[str, float]
    """Part of each frame that moves."""


def find_masked_poses(
    images: Path, frames: FrameSet, keep: Keep, *, seed: int = 0, threads: int | None = None
) -> MaskedPoses:
    """Find poses, and with them masks.

    `keep` runs the steps, or takes their earlier results. Arguments and errors are those of `find_poses`.
    """

    def find(folder: Path, progress: Progress) -> None:
        find_poses(images, frames, folder, seed=seed, threads=threads, progress=progress)

    poses = Poses.load(keep(POSES, find), frames)

    def mask(folder: Path, progress: Progress) -> None:
        shares = find_moving(images, frames, poses, folder / MASKS, progress=progress)
        write_text(folder / MOVING, json.dumps(shares, indent=1) + "\n")

    folder = keep(MASKS, mask)
    return MaskedPoses(poses, folder / MASKS, json.loads((folder / MOVING).read_text(encoding="utf-8")))

"""Poses of frames in which something moves: masks of it from the poses, and poses without features in the masks."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from msdgs_train.capture.frame_set import FrameSet
from msdgs_train.capture.moving import find_moving
from msdgs_train.capture.poses import Poses, find_poses

PASSES = 3
"""At most, with masks."""
GAIN = 0.03
"""Part by which the error must fall for another pass."""


class MaskedPoses(NamedTuple):
    """Poses, and where the frames move."""

    poses: Poses
    masks: Path
    """Folder of a mask of each frame's name, white where it moves, of the frames as they are."""
    moving: dict[str, float]
    """Part of each frame that moves."""
    passes: int
    """Passes with masks that were kept."""


def find_masked_poses(
    images: Path,
    frames: FrameSet,
    workspace: Path,
    *,
    seed: int = 0,
    threads: int | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> MaskedPoses:
    """Find poses and masks, each pass without the features that the last one found moving.

    A pass is kept if more frames have a pose, or as many at a smaller error; the masks are those that its poses were
    found with. Arguments and errors are those of `find_poses`.
    """

    def find(name: str, masks: Path | None) -> Poses:
        folder = workspace / name
        shutil.rmtree(folder, ignore_errors=True)
        return find_poses(images, frames, folder, masks=masks, seed=seed, threads=threads, progress=progress)

    poses, masks = find("pass0", None), workspace / "masks0"
    moving = find_moving(images, frames, poses, masks, progress=progress)
    passes = 0
    while passes < PASSES and poses.registered and not all(poses.fixed):
        again = find(f"pass{passes + 1}", masks)
        if not _is_better(again, poses):
            break
        passes += 1
        gain = 1 - again.summary.error / poses.summary.error
        registers_more = len(again.registered) > len(poses.registered)
        poses = again
        if not registers_more and gain < GAIN:
            break
        masks = workspace / f"masks{passes}"
        moving = find_moving(images, frames, poses, masks, progress=progress)
    return MaskedPoses(poses, masks, moving, passes)


def _is_better(one: Poses, other: Poses) -> bool:
    rank = len(other.registered) - len(one.registered), one.summary.error - other.summary.error
    return rank < (0, 0.0)

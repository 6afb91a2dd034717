"""Poses of frames in which something moves: masks of it from the poses, and poses without features in the masks."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from msdgs_serve.writing import write_text
from msdgs_train.capture.frame_set import FrameSet
from msdgs_train.capture.moving import find_moving
from msdgs_train.capture.poses import Poses, find_poses
from msdgs_train.capture.progress import Progress

PASSES = 3
"""At most, with masks."""
GAIN = 0.03
"""Part by which the error must fall, or the observations of points rise, for another pass."""
MASKS, MOVING = "masks", "moving.json"

Keep = Callable[[str, Callable[[Path, Progress], None]], Path]
"""Makes the result of a step of this name by a function that fills a folder, unless it is there; returns its folder."""


class MaskedPoses(NamedTuple):
    """Poses, and where the frames move."""

    poses: Poses
    masks: Path
    """Folder of a mask of each frame's name, white where it moves, of the frames as they are."""
    moving: dict[str, float]
    """Part of each frame that moves."""
    passes: int
    """Passes with masks that were kept."""


def step_names() -> list[str]:
    """Names of the steps in their order."""
    return [f"{kind}{_suffix(number)}" for number in range(PASSES + 1) for kind in ("poses", "masks")]


def find_masked_poses(
    images: Path, frames: FrameSet, keep: Keep, *, seed: int = 0, threads: int | None = None
) -> MaskedPoses:
    """Find poses and masks, each pass without the features that the last one found moving.

    A pass is kept if more frames have a pose, or as many at a smaller error or with more points seen; the masks are
    those that its poses were found with. `keep` runs the steps, or takes their earlier results. Arguments and errors
    are those of `find_poses`.
    """

    def find(number: int, masks: Path | None) -> Poses:
        def run(folder: Path, progress: Progress) -> None:
            find_poses(images, frames, folder, masks=masks, seed=seed, threads=threads, progress=progress)

        return Poses.load(keep(f"poses{_suffix(number)}", run), frames)

    def mask(number: int, poses: Poses) -> tuple[Path, dict[str, float]]:
        def run(folder: Path, progress: Progress) -> None:
            shares = find_moving(images, frames, poses, folder / MASKS, progress=progress)
            write_text(folder / MOVING, json.dumps(shares, indent=1) + "\n")

        folder = keep(f"masks{_suffix(number)}", run)
        return folder / MASKS, json.loads((folder / MOVING).read_text(encoding="utf-8"))

    poses = find(0, None)
    masks, moving = mask(0, poses)
    passes = 0
    while passes < PASSES and poses.registered and not all(poses.fixed):
        again = find(passes + 1, masks)
        if not _is_better(again, poses):
            break
        passes += 1
        goes_on = _is_better(again, poses, GAIN)
        poses = again
        if not goes_on:
            break
        masks, moving = mask(passes, poses)
    return MaskedPoses(poses, masks, moving, passes)


def _suffix(number: int) -> str:
    return f"-{number + 1}" if number else ""


def _is_better(one: Poses, other: Poses, gain: float = 0.0) -> bool:
    """Whether more frames have a pose, or as many at an error smaller by this part, or clearly more
    observations: wrong poses may have a small error, of the few points that agree with them."""
    if len(one.registered) != len(other.registered):
        return len(one.registered) > len(other.registered)
    sees_more = len(one.summary.observations) > (1 + GAIN) * len(other.summary.observations)
    return sees_more or one.summary.error < (1 - gain) * other.summary.error

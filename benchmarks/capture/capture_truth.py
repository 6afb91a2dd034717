"""Errors of the poses that a capture finds, on clips of known truth."""

import json
import sys
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import tyro
from rich.console import Console

from benchmarks.measuring import machine, report_console, table
from msdgs_serve.scene.camera import OPENGL_TO_OPENCV
from msdgs_serve.writing import scratch_folder
from msdgs_train.capture.frame_set import FrameSet
from msdgs_train.capture.frames import extract_frames
from msdgs_train.capture.offsets import find_offsets
from msdgs_train.capture.poses import Poses, find_poses
from tests.support.clips import Clip, fixed_camera_clips, moving_camera_clip

OFFSETS = (0.0, 0.08, 0.16, 0.24, 0.32, 0.4)  # seconds
COLUMNS = ("clip", "registered", "rotation °, median", "largest", "centers %, median", "largest", "reprojection px")


Part = Literal["moving", "fixed"]


class Errors(NamedTuple):
    """Errors after a similarity: rotations of the cameras give its rotation, centers its scale and translation."""

    rotations: np.ndarray  # [N] degrees
    centers: np.ndarray  # [N] percent of the diagonal of the box around the true centers


def main(
    parts: tuple[Part, ...] = ("moving", "fixed"),
    frames: int = 48,
    arc: float = 60.0,
    width: int = 320,
    rig_frames: int = 16,
    threads: int = 1,
    seed: int = 0,
    video: Path | None = None,
    poses: Path | None = None,
    check: bool = False,
) -> int:
    """Find the poses of synthetic clips, and of a real video with given poses, and print their errors.

    python -m benchmarks.capture.capture_truth --video hand.mp4 --poses precomputed.json

    A camera moves around moving toys in front of a poster that swings, and poses are found of all matches and of those
    on what stands still; six cameras stand around the toys. Centers' errors are percentages of the diagonal of the box
    around the true centers.

    Args:
        parts: Clips: a moving camera, six fixed ones.
        frames: Frames of the moving camera's clip.
        arc: Degrees of its path.
        width: Pixels of the clips.
        rig_frames: Frames of each fixed camera.
        threads: Threads of COLMAP; with one the figures repeat.
        seed: Seed of the clips and of COLMAP.
        video: A real video.
        poses: Its poses as JSON: `poses`, a 3×5 matrix a frame as in LLFF but with OpenGL axes.
        check: Test this benchmark with tiny clips.
    """
    if check:
        return self_test()
    made = table(f"{frames} frames of {width} px, seed {seed}, {threads} thread(s)", *COLUMNS)
    with scratch_folder() as folder:
        if "moving" in parts:
            clip = moving_camera_clip(folder / "clip.mp4", width=width, frames=frames, arc=arc, seed=seed)
            share = f"{clip.moving.mean():.0%} moves"
            for name, found, taken in _both_ways(clip.file, folder / "clip", seed, threads):
                made.add_row(f"arc of {arc:g}°, {share}, {name}", *_row(found, taken, clip.camera_to_world, clip.times))
        if "fixed" in parts:
            rig = fixed_camera_clips(folder, width=width, frames=rig_frames, offsets=OFFSETS, seed=seed)
            off, cells = rig_row(rig, folder / "rig", seed, threads)
            made.add_row(f"six fixed cameras, offsets within {off:.2f} frames", *cells)
        if video is not None and poses is not None:
            given = read_poses(poses)
            for name, found, taken in _both_ways(video, folder / "video", seed, threads):
                made.add_row(f"{video.name}, {name}", *_row(found, taken, given, None))
    report_console().print(machine(), made)
    return 0


def _both_ways(video: Path, folder: Path, seed: int, threads: int) -> list[tuple[str, Poses, FrameSet]]:
    images = folder / "images"
    taken = extract_frames([video], images)
    found = []
    for name, all_matches in (("all matches", True), ("what stands still", False)):
        poses = find_poses(
            images, taken, folder / name, seed=seed, threads=threads, all_matches=all_matches, progress=_progress
        )
        found.append((name, poses, taken))
    return found


def rig_row(rig: list[Clip], folder: Path, seed: int, threads: int) -> tuple[float, list[str]]:
    """The largest error of the starts in frames, and the cells of fixed cameras, one pose each."""
    images, files = folder / "images", [clip.file for clip in rig]
    heard = find_offsets(files).seconds
    frame = rig[0].times[1] - rig[0].times[0]
    off = float(np.abs(np.array(heard) - [clip.offset for clip in rig]).max() / frame)
    taken = extract_frames(files, images, offsets=heard)
    found = find_poses(images, taken, folder, seed=seed, threads=threads, progress=_progress)
    cameras = {frame.name: frame.camera for frame in taken.frames}
    rows = [cameras[name] for name in found.registered]
    return off, _cells(found, len(taken.frames), np.array([rig[row].camera_to_world[0] for row in rows]))


def _row(found: Poses, taken: FrameSet, truth: np.ndarray, times: np.ndarray | None) -> list[str]:
    """The row of a moving camera; frames are those at the nearest of `times`, or all in their order."""
    order = {frame.name: index for index, frame in enumerate(taken.frames)}
    rows = np.array([order[name] for name in found.registered], int)
    if times is not None:
        at = np.array([frame.time for frame in taken.frames])[rows]
        rows = np.abs(at[:, None] - times).argmin(axis=1)
    return _cells(found, len(taken.frames), truth[rows])


def _cells(found: Poses, count: int, truth: np.ndarray) -> list[str]:
    registered = f"{len(found.registered)} of {count}"
    if len(truth) < 3:
        return [registered, *["-"] * 4, f"{found.summary.error:.2f}"]
    errors = errors_of(found.summary.camera_to_world, truth)
    figures = [f"{reduce(each):.2f}" for each in errors for reduce in (np.median, np.max)]
    return [registered, *figures, f"{found.summary.error:.2f}"]


def errors_of(found: np.ndarray, truth: np.ndarray) -> Errors:
    """Errors of [N, 4, 4] poses, camera to world, against true ones, after the best similarity."""
    products = truth[:, :3, :3] @ found[:, :3, :3].transpose(0, 2, 1)
    left, _, right = np.linalg.svd(products.sum(axis=0))
    rotation = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
    centers, true = found[:, :3, 3] @ rotation.T, truth[:, :3, 3]
    centers, true = centers - centers.mean(axis=0), true - true.mean(axis=0)
    scale = (centers * true).sum() / (centers**2).sum()
    extent = np.linalg.norm(np.ptp(true, axis=0))
    turns = np.einsum("nij,nij->n", rotation @ found[:, :3, :3], truth[:, :3, :3])
    rotations = np.degrees(np.arccos(np.clip((turns - 1) / 2, -1, 1)))
    return Errors(rotations, 100 * np.linalg.norm(scale * centers - true, axis=1) / extent)


def read_poses(file: Path) -> np.ndarray:
    """[N, 4, 4] camera to world, OpenCV axes, of `poses`."""
    given = np.array(json.loads(file.read_text(encoding="utf-8"))["poses"])
    poses = np.tile(np.eye(4), (len(given), 1, 1))
    poses[:, :3] = given[:, :, :4]
    return poses @ OPENGL_TO_OPENCV


def _progress(stage: str, done: int, total: int) -> None:
    if done == total:
        Console(stderr=True).print(f"{stage}: {total}", markup=False)


def self_test() -> int:
    """A similarity leaves no errors, and a turned and moved camera has its own."""
    random = np.random.default_rng(0)
    with scratch_folder() as folder:
        truth = moving_camera_clip(folder / "clip.mp4", width=64, frames=6).camera_to_world
    turn = np.linalg.qr(random.standard_normal((3, 3)))[0]
    turn *= np.linalg.det(turn)
    found = truth.copy()
    found[:, :3, :3] = turn @ truth[:, :3, :3]
    found[:, :3, 3] = 3 * truth[:, :3, 3] @ turn.T + 1
    for errors in errors_of(found, truth):
        np.testing.assert_allclose(errors, 0, atol=1e-4)
    found[0, :3, :3] = found[1, :3, :3]
    assert errors_of(found, truth).rotations.max() > 1
    return main(frames=16, arc=30.0, width=160, rig_frames=4)


if __name__ == "__main__":
    sys.exit(tyro.cli(main))

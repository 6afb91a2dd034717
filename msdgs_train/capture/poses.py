"""Camera poses of the frames of a capture, by structure from motion with COLMAP.

A moving camera has a view for each of its frames. The frames of a camera that stands still share one pose: its view is
the background, the median of its frames, which is free of what moves. Views of one camera share its intrinsics.

A model of keyframes is made of matches on what stands still (`static_tracks`), and then refined with all that agree
with its poses. The other frames are registered to it.
"""

from dataclasses import dataclass
from pathlib import Path

from msdgs_train.capture.fixed_cameras import background, is_fixed
from msdgs_train.capture.frame_set import FrameSet
from msdgs_train.capture.image_files import write_image
from msdgs_train.capture.progress import Progress
from msdgs_train.capture.sfm_process import CameraViews, PosesJob, run_sfm
from msdgs_train.capture.sparse_model import GEOMETRY, Summary
from msdgs_train.capture.views import View, keyframes, matched_pairs, pairs_with_keyframes

SPARSE = "sparse"
BACKGROUNDS = "backgrounds"
ALL_PROCESSORS = -1


@dataclass(frozen=True)
class Poses:
    """A sparse model of the frames, in units and axes of its own."""

    model: Path
    """Folder of the model in COLMAP's format, of images that are not undistorted."""
    summary: Summary
    fixed: tuple[bool, ...]
    """Of each camera, whether it stands still."""

    @property
    def registered(self) -> tuple[str, ...]:
        """Names of the frames with a pose, sorted."""
        return tuple(str(name) for name in self.summary.names)

    @staticmethod
    def load(workspace: Path, frames: FrameSet) -> "Poses":
        """What `find_poses` left in a workspace, for the same frames."""
        backgrounds = {file.stem for file in (workspace / BACKGROUNDS).glob("*.png")}
        fixed = tuple(str(camera) in backgrounds for camera in range(len(frames.cameras)))
        return Poses(workspace / SPARSE, Summary.load(workspace / GEOMETRY), fixed)


def find_poses(
    images: Path,
    frames: FrameSet,
    workspace: Path,
    *,
    seed: int = 0,
    threads: int | None = None,
    all_matches: bool = False,
    progress: Progress | None = None,
) -> Poses:
    """Find the poses of frames in the folder `images`; `workspace` takes the database, the model and `geometry.npz`.

    One thread gives the same poses each time. With `all_matches` those on what moves count as well, for comparison.
    `progress` is called with the stage, what is done and the total. Raises `CaptureFailed` if COLMAP ends with an
    error; without any model the result has no registered frames.
    """
    workspace = workspace.absolute()
    workspace.mkdir(parents=True, exist_ok=True)
    names = [tuple(frame.name for frame in frames.frames if frame.camera == i) for i in range(len(frames.cameras))]
    fixed = tuple(_background(images, own, workspace, camera) for camera, own in enumerate(names))
    views = [View(frame.name, frame.camera, frame.time) for frame in frames.frames if not fixed[frame.camera]] + [
        View(f"{camera}.png", camera, 0.0, True) for camera, stands in enumerate(fixed) if stands
    ]
    keys = keyframes(views)
    chosen = {view.name for view in keys}
    cameras = tuple(
        CameraViews(str(workspace / BACKGROUNDS), (f"{camera}.png",), own)
        if fixed[camera]
        else CameraViews(
            str(images.absolute()),
            tuple(name for name in own if name in chosen),
            others=tuple(name for name in own if name not in chosen),
        )
        for camera, own in enumerate(names)
        if own
    )
    pairs, other_pairs = tuple(matched_pairs(keys)), tuple(pairs_with_keyframes(views, keys))
    job = PosesJob(str(workspace), cameras, pairs, other_pairs, seed, threads or ALL_PROCESSORS, all_matches)
    run_sfm(job, images, progress)
    return Poses.load(workspace, frames)


def _background(images: Path, names: tuple[str, ...], workspace: Path, camera: int) -> bool:
    """Write the background of a camera, if it is fixed, and return whether it is."""
    files = [images / name for name in names]
    file = workspace / BACKGROUNDS / f"{camera}.png"
    file.unlink(missing_ok=True)
    if not is_fixed(files):
        return False
    write_image(file, background(files))
    return True

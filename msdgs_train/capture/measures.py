"""What the frames and poses of a capture measure: the figures of its verdict and of its report."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import groupby, pairwise

import numpy as np

from msdgs_train.capture.frame_set import FrameSet
from msdgs_train.capture.poses import Poses

STRETCH = 0.1
"""Share of a camera's frames, from which on a run of frames with poses, or without, is no accident."""


@dataclass(frozen=True)
class Measures:
    """Figures of a capture. Those of poses are 0 before they are known."""

    cameras: int
    frames: int
    """Taken from the recordings."""
    available: int
    """In the recordings."""
    seconds: float
    """From the first frame to the last."""
    blurred: int
    """Intervals that are left out, as all of their frames are blurred."""
    cuts: tuple[float, ...]
    """Seconds at which the picture changes as a whole."""
    black: float
    """Share of the frames in the recordings that are left out as black."""
    repeated: int = 0
    """Frames that are left out as they show the picture before again."""
    registered: int = 0
    """Frames with a pose."""
    fixed: int = 0
    """Cameras that stand still."""
    points: int = 0
    other_models: tuple[int, ...] = ()
    """Keyframes of models that are not used."""
    method: str = ""
    """The mapper whose model is used: incremental or global."""
    reprojection_error: float = 0.0
    """Mean, in pixels."""
    parallax: float = 0.0
    """Degrees: median over frames of the frame's parallax, which is the median over its points of the largest angle
    between its ray and another frame's."""
    parallax_of_frames: tuple[float, ...] = ()
    """By registered frame, in the order of names."""
    baseline: float = 0.0
    """Largest distance of two camera centers over the median depth of the points."""
    seen: float = 0.0
    """Points that a registered frame sees, median."""
    size: int = 1
    """Longer side of the frames in pixels."""
    beyond_rotation: float = 0.0
    """Pixels of the motion between frames of one camera that no rotation explains."""
    moving: float = 0.0
    """Mean share of a frame that moves."""
    agreement: float = 0.0
    """Observations of points, relative to the features that are found again in several frames; may be above 1, and
    says nothing of cameras that all stand still."""
    breaks: tuple[float, ...] = ()
    """Seconds at which a stretch of frames with poses borders on one without, as at a cut."""


def measure_frames(frames: FrameSet) -> Measures:
    """The figures that frames have without poses."""
    times, available = [frame.time for frame in frames.frames], sum(camera.available for camera in frames.cameras)
    return Measures(
        cameras=len(frames.cameras),
        frames=len(frames.frames),
        available=available,
        size=max((max(camera.width, camera.height) for camera in frames.cameras), default=1),
        seconds=max(times, default=0.0) - min(times, default=0.0),
        blurred=frames.blurred,
        cuts=frames.cuts,
        black=frames.black / max(available, 1),
        repeated=frames.repeated,
    )


def measure_poses(measures: Measures, frames: FrameSet, poses: Poses, moving: Mapping[str, float]) -> Measures:
    """Add the figures of poses, and of masks: `moving` is the share of each frame that moves."""
    model = poses.summary
    measures = replace(
        measures,
        registered=len(poses.registered),
        fixed=sum(poses.fixed),
        points=len(model.points),
        other_models=model.others,
        method=model.method,
        beyond_rotation=model.beyond_rotation,
        agreement=model.agreement,
        moving=float(np.mean(list(moving.values()))) if moving else 0.0,
        breaks=_breaks(frames, set(poses.registered)),
    )
    if not len(model.observations):
        return measures
    seen, parallax = _of_frames(frames, poses)
    return replace(
        measures,
        reprojection_error=model.error,
        parallax=float(np.median(parallax)),
        parallax_of_frames=tuple(float(angle) for angle in parallax),
        baseline=_extent(model.centers) / float(np.median(model.depths())),
        seen=float(np.median(seen)),
    )


def _of_frames(frames: FrameSet, poses: Poses) -> tuple[np.ndarray, np.ndarray]:
    """[N] points that each registered frame sees, and its parallax in degrees. All frames of a fixed camera have those
    of its background, which is the only one that was matched."""
    model, of_name = poses.summary, {frame.name: frame.camera for frame in frames.frames}
    cameras = np.array([of_name[str(name)] for name in model.names])
    seen, parallax = np.bincount(model.observations[:, 0], minlength=len(cameras)), np.nan_to_num(model.parallax())
    for camera in np.unique(cameras):
        if poses.fixed[camera]:
            own = cameras == camera
            seen[own], parallax[own] = seen[own].max(), parallax[own].max()
    return seen, parallax


def _breaks(frames: FrameSet, registered: set[str]) -> tuple[float, ...]:
    found = []
    for camera in range(len(frames.cameras)):
        own = [(frame.time, frame.name in registered) for frame in frames.frames if frame.camera == camera]
        stretches = [list(run) for _, run in groupby(own, key=lambda each: each[1])]
        long = [run for run in stretches if len(run) >= max(3, STRETCH * len(own))]
        found += [after[0][0] for before, after in pairwise(long) if before[0][1] != after[0][1]]
    return tuple(found)


def _extent(centers: np.ndarray) -> float:
    return float(np.linalg.norm(centers[:, None] - centers[None], axis=2).max())

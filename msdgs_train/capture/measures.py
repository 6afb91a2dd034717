"""What the frames and poses of a capture measure: the figures of its verdict and of its report."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from msdgs_train.capture.frame_set import FrameSet
from msdgs_train.capture.poses import Poses


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
    """Share of the frames that are left out as black."""
    repeated: int = 0
    """Frames that are left out as they show the picture before again."""
    registered: int = 0
    """Frames with a pose."""
    fixed: int = 0
    """Cameras that stand still."""
    points: int = 0
    other_models: tuple[int, ...] = ()
    """Frames of models that are not used."""
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
    cut_apart: tuple[float, ...] = ()
    """Cuts of which only one side has poses, in seconds."""


def measure_frames(frames: FrameSet) -> Measures:
    """The figures that frames have without poses."""
    times = [frame.time for frame in frames.frames]
    return Measures(
        cameras=len(frames.cameras),
        frames=len(frames.frames),
        available=sum(camera.available for camera in frames.cameras),
        size=max((max(camera.width, camera.height) for camera in frames.cameras), default=1),
        seconds=max(times, default=0.0) - min(times, default=0.0),
        blurred=frames.blurred,
        cuts=frames.cuts,
        black=frames.black / max(frames.black + len(frames.frames), 1),
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
        moving=float(np.mean(list(moving.values()))) if moving else 0.0,
        cut_apart=_cut_apart(frames, set(poses.registered)),
    )
    if not len(model.observations):
        return measures
    parallax = np.nan_to_num(model.parallax())
    return replace(
        measures,
        reprojection_error=model.error,
        parallax=float(np.median(parallax)),
        parallax_of_frames=tuple(float(angle) for angle in parallax),
        baseline=_extent(model.centers) / float(np.median(model.depths())),
        seen=float(np.median(np.bincount(model.observations[:, 0], minlength=len(model.names)))),
    )


def _cut_apart(frames: FrameSet, registered: set[str]) -> tuple[float, ...]:
    """The cuts on one side of which, up to the next cut, fewer than half of the frames have a pose."""
    edges = [-np.inf, *frames.cuts, np.inf]
    has_poses = []
    for start, end in pairwise(edges):
        part = [frame.name in registered for frame in frames.frames if start <= frame.time < end]
        has_poses.append(not part or float(np.mean(part)) >= 0.5)
    sides = zip(frames.cuts, pairwise(has_poses), strict=True)
    return tuple(cut for cut, both in sides if not all(both))


def _extent(centers: np.ndarray) -> float:
    return float(np.linalg.norm(centers[:, None] - centers[None], axis=2).max())

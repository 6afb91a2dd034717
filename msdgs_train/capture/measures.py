"""What the frames and poses of a capture measure: the figures of its verdict and of its report."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from msdgs_train.capture.frame_set import FrameSet
from msdgs_train.capture.poses import Poses
from msdgs_train.capture.rotation import beyond_rotation
from msdgs_train.capture.sparse_model import Summary


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
    beyond_rotation: float = 0.0
    """Pixels by which points move in the widest pairs of a moving camera's frames, beyond what a rotation explains; the
    largest over the cameras."""
    rotation_only: float = 0.0
    """Share of matched pairs of frames that a rotation explains."""
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
        rotation_only=model.rotation_only,
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
        beyond_rotation=max(
            (beyond_rotation(model, rows) for rows in _moving_cameras(frames, poses, model)), default=0
        ),
    )


def _moving_cameras(frames: FrameSet, poses: Poses, model: Summary) -> list[np.ndarray]:
    """Rows in the model of the frames of each moving camera, in the order of time."""
    rows = {str(name): row for row, name in enumerate(model.names)}
    return [
        np.array([rows[frame.name] for frame in frames.frames if frame.camera == camera and frame.name in rows], int)
        for camera in range(len(frames.cameras))
        if not poses.fixed[camera]
    ]


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

"""Candidates that are measured in full: time, memory and errors; and those of them on the Pareto front."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from operator import le
from typing import Any

from msdgs_export.jobs.candidate import Candidate, Measured, usable
from msdgs_export.jobs.frame_memory import frame_memory
from msdgs_export.jobs.ruler import Ruler
from msdgs_export.jobs.timing import FrameTime, time_frames
from msdgs_export.measure.rendered_error import RenderedError
from msdgs_export.measure.views import View
from msdgs_export.target import Target
from msdgs_serve.scene.metadata import SceneCamera

TIME_MARGIN = 1.15
"""A factor of time that doesn't count: timings of one file differ by as much."""


@dataclass(frozen=True, eq=False)
class Point:
    """A candidate, measured in full."""

    candidate: Candidate
    time: FrameTime
    error: RenderedError
    memory: int | None  # bytes at the peak of a frame
    images_psnr: float | None

    @property
    def measured(self) -> Measured:
        """The candidate and its error."""
        return Measured(self.candidate, self.error)

    @property
    def milliseconds(self) -> float:
        """Minimum over the repeats of a whole frame."""
        return self.time.total.min

    @property
    def costs(self) -> tuple[float, float, int]:
        """What is better if smaller: milliseconds, negative PSNR of the worst frame, bytes."""
        return self.milliseconds, -self.error.psnr_worst, self.candidate.size

    def to_plain(self) -> dict[str, Any]:
        """Plain values for JSON."""
        scene = self.candidate.session.scene
        return self.candidate.to_plain() | {
            "moving": scene.moving_count,
            "static": scene.static_count,
            "layers": len(scene.metadata.layers),
            "bytes": self.candidate.size,
            "packed": self.candidate.float32 is not None,
            "memory_bytes": self.memory,
            "milliseconds": self.time.to_plain(),
            "error": self.error.to_plain(),
            "images_psnr": self.images_psnr,
            "left_out": list(scene.metadata.left_out),
        }


def front(points: Sequence[Point]) -> list[int]:
    """Indices of the points on the Pareto front of time, error and bytes, the fastest first."""
    fast = sorted((point.costs, i) for i, point in enumerate(points))
    return [i for n, (costs, i) in enumerate(fast) if not any(all(map(le, other, costs)) for other, _ in fast[:n])]


def choose(points: Sequence[Point], target: Target) -> int:
    """The index of the smallest of the points about as fast as the fastest, of those whose error is allowed; or if
    bytes alone are limited, of the one with the smallest error. It lies on the front.

    Points that leave something for storage are preferred if they are as fast. Raises `TargetNotReached`.
    """

    def preferred(allowed: Sequence[Point]) -> Point:
        leaves_room = [point for point in allowed if point.error.psnr_worst >= target.plan_psnr]
        if leaves_room:
            best = _smallest_of_fastest(leaves_room)
            if best.milliseconds <= TIME_MARGIN * allowed[0].milliseconds:
                return best
        return _smallest_of_fastest(allowed)

    # estimates see only some of the frames, in float32
    where = "a file reaches" if target.max_bytes is None else "a file reaches that fits"
    return points.index(target.best([points[i] for i in front(points)], where, preferred))


def _smallest_of_fastest(points: Sequence[Point]) -> Point:
    """The smallest of the points about as fast as the first, which is the fastest."""
    fast = [point for point in points if point.milliseconds <= TIME_MARGIN * points[0].milliseconds]
    return min(fast, key=lambda point: point.candidate.size)


def points_of(
    measured: Sequence[Measured], views: Sequence[View], ruler: Ruler, refused: list[tuple[str, str]]
) -> list[Point]:
    """Points of candidates, timed in `views`, but for those that can't be drawn at a held-out image's time; these are
    added to `refused`."""
    errors = dict(measured)
    images = dict(usable(errors, lambda candidate: (candidate, ruler.images_psnr(candidate)), refused))
    candidates = list(images)
    times = time_frames(candidates, views, ruler.background, ruler.track)
    parts = zip(candidates, times, _memory(candidates, ruler), strict=True)
    return [Point(c, time, errors[c], memory, images[c]) for c, time, memory in parts]


def as_stored(point: Point, stored: Measured, ruler: Ruler) -> Point:
    """A point with the file in which its candidate is stored: measured in full, but for times, which are the same."""
    candidate, error = stored
    if candidate is point.candidate:
        return point
    (memory,), images_psnr = _memory([candidate], ruler), ruler.images_psnr(candidate)
    return replace(point, candidate=candidate, error=error, memory=memory, images_psnr=images_psnr)


def _memory(candidates: Sequence[Candidate], ruler: Ruler) -> list[int | None]:
    view = ruler.views[0]
    camera = SceneCamera("timed", view.t, view.camera)
    return frame_memory([candidate.path for candidate in candidates], camera, ruler.track)

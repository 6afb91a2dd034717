"""Points of a work-precision diagram: time of a frame and error against the exact one."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from export.jobs.job import Candidate
from export.measure.rendered_error import RenderedError
from export.measure.timing import FrameTime

DEFAULT_RASTERIZER = "default"


@dataclass(frozen=True, eq=False)
class QuickEstimate:
    """A quick estimate of a candidate: the error of some of its frames, and the processor time of one.

    Processor time is summed over threads; unlike elapsed time it hardly depends on other programs.
    """

    candidate: Candidate
    cpu: float  # milliseconds per frame, the minimum of a few
    cpu_deformation: float  # milliseconds of these
    worst_db: float  # PSNR of the worst of these frames

    def dominates(self, other: "QuickEstimate", *, time_margin: float, db_margin: float) -> bool:
        """Whether it is faster and has a smaller error than another, by more than the margins."""
        faster = self.cpu * time_margin < other.cpu
        return faster and self.worst_db > other.worst_db + db_margin

    def to_plain(self) -> dict[str, Any]:
        """Plain values for JSON."""
        quick = {"cpu_milliseconds": self.cpu, "psnr_worst": self.worst_db}
        return named(self.candidate, DEFAULT_RASTERIZER) | {"quick_estimate": quick}


@dataclass(frozen=True, eq=False)
class Point:
    """A candidate, measured in full."""

    candidate: Candidate
    rasterizer: str
    time: FrameTime
    error: RenderedError
    memory: int | None  # bytes at the peak of a frame
    images_psnr: float | None

    @property
    def milliseconds(self) -> float:
        """Minimum over the repeats of a whole frame."""
        return self.time.total.min

    def to_plain(self) -> dict[str, Any]:
        """Plain values for JSON."""
        scene = self.candidate.session.scene
        return named(self.candidate, self.rasterizer) | {
            "moving": scene.moving_count,
            "static": scene.static_count,
            "layers": len(scene.metadata.layers),
            "bytes": self.candidate.size,
            "memory_bytes": self.memory,
            "milliseconds": self.time.to_plain(),
            "error": self.error.to_plain(),
            "images_psnr": self.images_psnr,
            "left_out": list(scene.metadata.left_out),
        }


def named(candidate: Candidate, rasterizer: str) -> dict[str, Any]:
    """The keys that identify a point."""
    c = candidate
    return {"plan": c.plan, "pruning_db": c.pruning_db, "sh_degree": c.sh_degree, "rasterizer": rasterizer}


def front(points: Sequence[Point]) -> list[int]:
    """Indices of the points on the Pareto front of time and error, the fastest first.

    Only those with default rasterizer options, since a file can't ask for others.
    """
    usual = [i for i, point in enumerate(points) if point.rasterizer == DEFAULT_RASTERIZER]
    best, kept = -1.0, []
    for i in sorted(usual, key=lambda i: (points[i].milliseconds, -points[i].error.psnr_worst)):
        if points[i].error.psnr_worst > best:
            best = points[i].error.psnr_worst
            kept.append(i)
    return kept


def choose(points: Sequence[Point], min_psnr: float) -> int | None:
    """The index of the fastest point whose worst frame is within `min_psnr` dB, which lies on the front."""
    within = [i for i in front(points) if points[i].error.psnr_worst >= min_psnr]
    return within[0] if within else None

"""The rendered error of an export: its frames against exact ones."""

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np

from msdgs_export.measure.frames import compare, in_frame, project, render
from msdgs_export.measure.poses import Pose
from msdgs_export.measure.views import View
from msdgs_serve.rasterizer import RasterizerOptions
from msdgs_serve.scene.camera import Camera
from msdgs_serve.scene.gaussians import FloatArray, Gaussians

MEMORY = 768e6
"""Largest size in bytes of exact frames and poses; with larger images there are fewer views."""

BLOCK = 1 << 15
"""Points projected at a time: projecting millions at once takes three times as long."""

POSE_BYTES = 52
"""Bytes per Gaussian and time: its mean in float64, the rest in float32."""


class WorstFrame(NamedTuple):
    """The frame with the largest error."""

    camera: str
    t: float


@dataclass(frozen=True)
class RenderedError:
    """Error of frames against exact ones, both clamped to [0, 1]."""

    psnr_mean: float  # dB, mean over frames of their PSNR; at most 100
    psnr_worst: float  # dB, of the worst frame
    worst_frame: WorstFrame | None  # None if nothing was drawn
    worst_pixel: float  # largest difference of a channel, in [0, 1]
    position: float  # largest displacement of a Gaussian, world units
    position_pixels: float  # the same in pixels, of Gaussians inside the image
    frames: int

    def to_plain(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return asdict(self) | {"worst_frame": self.worst_frame and self.worst_frame._asdict()}


class ExactFrames:
    """Frames of all Gaussians in the poses' precision, computed once and compared with many candidates."""

    def __init__(
        self,
        pose: Pose,
        views: Sequence[View],
        background: Sequence[float],
        options: RasterizerOptions,
        on_frame: Callable[[], object] = lambda: None,
        unit: float = 1.0,
    ) -> None:
        """`unit`: world units per unit of the poses."""
        self._unit = unit
        self.pose, self.views, self.background, self.options = pose, views, background, options
        self._frames: list[FloatArray] = []
        self._poses: dict[float, Gaussians] = {}
        for t, views_then in by_time(self.views):
            gaussians = self.pose(t)
            quats, scales = gaussians.quats.astype(np.float32), gaussians.scales.astype(np.float32)
            first = next(iter(self._poses.values()), gaussians)
            self._poses[t] = Gaussians(gaussians.means, quats, scales, first.opacities, first.sh)
            for view in views_then:
                self._frames.append(render(gaussians, view.camera, background, options).astype(np.float32))
                on_frame()

    def kept(self, t: float) -> Gaussians:
        """All Gaussians at one of the views' times; quaternions and scales rounded to float32, opacities and SH of the
        first time."""
        return self._poses[t]

    def measure(
        self, pose: Pose, ids: np.ndarray, *, every: int = 1, on_frame: Callable[[], object] = lambda: None
    ) -> RenderedError:
        """The error of `pose`, whose rows are the Gaussians `ids`, over all views or every n-th of them."""
        psnrs: list[float] = []
        worst, worst_frame, worst_pixel, position, position_pixels = np.inf, None, 0.0, 0.0, 0.0
        chosen = list(zip(self.views, self._frames, strict=True))[::every]
        frames = {id(view): frame for view, frame in chosen}
        for t, views in by_time([view for view, _ in chosen]):
            gaussians = pose(t)
            exact_means = self._poses[t].means[ids]
            distances = np.linalg.norm(gaussians.means - exact_means, axis=1)
            position = max(position, self._unit * float(distances.max(initial=0)))
            for view in views:
                drawn = render(gaussians, view.camera, self.background, self.options)
                difference = compare(drawn, frames[id(view)])
                psnrs.append(difference.psnr)
                worst_pixel = max(worst_pixel, difference.worst_pixel)
                offset = _largest_pixel_distance(view.camera, gaussians.means, exact_means)
                position_pixels = max(position_pixels, offset)
                if psnrs[-1] < worst:
                    worst, worst_frame = psnrs[-1], WorstFrame(view.name, t)
                on_frame()
        return RenderedError(
            float(np.mean(psnrs)), min(psnrs), worst_frame, worst_pixel, position, position_pixels, len(psnrs)
        )


def by_time(views: Sequence[View]) -> Iterator[tuple[float, list[View]]]:
    """Consecutive views of one time, grouped."""
    for t, group in itertools.groupby(views, key=lambda view: view.t):
        yield t, list(group)


def within_memory(views: Sequence[View], gaussians: int) -> list[View]:
    """Evenly spread views, as many as fit into `MEMORY` with their exact frames and poses."""
    sizes = [12 * view.camera.width * view.camera.height + POSE_BYTES * gaussians for view in views]
    count = min(len(views), max(2, int(MEMORY / (sum(sizes) / len(sizes)))))
    return [views[i] for i in np.linspace(0, len(views) - 1, count).round().astype(int)]


def _largest_pixel_distance(camera: Camera, got: FloatArray, exact: FloatArray) -> float:
    """Of the points `got` from the points `exact`, [M, 3] each, of those inside the image."""
    largest = 0.0
    for start in range(0, len(exact), BLOCK):
        rows = slice(start, start + BLOCK)
        pixels, depths = project(exact[rows], camera)
        inside = in_frame(pixels, depths, camera)
        distances = np.linalg.norm(project(got[rows][inside], camera)[0] - pixels[inside], axis=1)
        largest = max(largest, float(distances.max(initial=0)))
    return largest

"""A scene, a camera and a time → an image. No HTTP here."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from msdgs_serve.deformation import DeformationSession
from msdgs_serve.imaging import Image, average
from msdgs_serve.pose_cache import PoseCache
from msdgs_serve.rasterizer import GSPLAT, RasterizerOptions, as_trained, rasterize
from msdgs_serve.render_job import RenderJob
from msdgs_serve.scene import Camera, Gaussians, InvalidInput

Color = tuple[float, float, float]
Background = Color | Literal["scene", "transparent"]

DEFAULT_CACHE_BYTES = 256 << 20


@dataclass(frozen=True)
class Shutter:
    """When the light comes in: from `t + open` to `t + close`, in the scene's units of time."""

    open: float
    close: float
    samples: int  # moments, in the middles of equal parts of that time

    def __post_init__(self) -> None:
        if not self.open < self.close:
            raise InvalidInput("shutter.close", f"after shutter.open, {self.open}", self.close)
        if self.samples < 1:
            raise InvalidInput("shutter.samples", "at least 1", self.samples)

    def times(self, t: float) -> list[float]:
        """The moments, about the time `t` of the frame."""
        step = (self.close - self.open) / self.samples
        return [t + self.open + (number + 0.5) * step for number in range(self.samples)]


@dataclass(frozen=True)
class RenderOptions:
    """How a frame is drawn."""

    background: Background = "scene"  # an sRGB-encoded color, what the scene was trained on, or none
    shutter: Shutter | None = None  # motion blur; None: one moment
    motion_dt: float | None = None  # draw motion vectors too, to this much later; not together with a shutter
    depth: bool = False  # draw how far what is seen is too
    counts: bool = False  # count the Gaussians that add to each pixel too
    steps: float | None = None  # after so many of the scene's layers; None: all
    rasterizer: RasterizerOptions = GSPLAT


DEFAULT_OPTIONS = RenderOptions()


class Renderer:
    """Draws scenes, and remembers the Gaussians posed last. Safe to use from several threads.

    Requests for the same scene and time that arrive together pose its Gaussians once.
    """

    def __init__(self, cache_bytes: int = DEFAULT_CACHE_BYTES) -> None:
        self.cache = PoseCache(cache_bytes)

    def render(
        self,
        session: DeformationSession,
        camera: Camera,
        t: float,
        options: RenderOptions = DEFAULT_OPTIONS,
        job: RenderJob | None = None,
    ) -> Image:
        """The frame that `camera` sees at `t`. The same arguments give the same pixels, whatever else runs.

        `job` times the stages `pose` and `draw` and may end the work between them.

        Raises:
            InvalidInput: if `t` or a moment of the shutter is outside of the scene's time range, or it has no such
                steps.
            RenderCancelled: if the job was stopped.
            SceneFileInvalid: if the scene's Gaussians at such a moment are none that can be drawn.
        """
        job = job or RenderJob()
        check_times(session, t, options.shutter, options.motion_dt)
        if options.shutter is None:
            return self._moment(session, camera, t, t, options, job)
        moments = options.shutter.times(t)
        return average(self._moment(session, camera, t, moment, options, job) for moment in moments)

    def posed(
        self, session: DeformationSession, t: float, job: RenderJob | None = None, steps: float | None = None
    ) -> Gaussians:
        """The scene's Gaussians at `t`, from the cache where it has them."""
        return self.cache.get(session, t, job or RenderJob(), steps)

    def _moment(
        self,
        session: DeformationSession,
        camera: Camera,
        t: float,
        moment: float,
        options: RenderOptions,
        job: RenderJob,
    ) -> Image:
        gaussians, later = self.posed(session, moment, job, options.steps), None
        if options.motion_dt is not None:
            later = self.posed(session, moment + options.motion_dt, job, options.steps)
        with job.stage("draw"), session.blaming_scene_file(moment):
            background = resolve_background(session, options.background)
            constants = as_trained(session.scene.metadata, options.rasterizer)
            extra = None if later is None else displacements(gaussians, later, camera)
            drawn = rasterize(
                gaussians,
                camera,
                background=background,
                depth=options.depth,
                extra=extra,
                counts=options.counts,
                options=constants,
            )
            transparent = options.background == "transparent"
            motion = None if extra is None else drawn.extra / np.where(drawn.alpha > 0, drawn.alpha, 1)[..., None]
            depth, counts = drawn.depth if options.depth else None, drawn.counts if options.counts else None
            return Image(drawn.rgb, drawn.alpha, depth, transparent, camera, t, motion, counts)


def displacements(now: Gaussians, later: Gaussians, camera: Camera) -> np.ndarray:
    """[N, 2] how far each centre goes in the image of `camera`, pixels to the right and down.

    0 for those that are behind the camera at one of the times.
    """
    (start, start_depths), (end, end_depths) = camera.project(now.means), camera.project(later.means)
    seen = (start_depths > GSPLAT.near_plane) & (end_depths > GSPLAT.near_plane)
    return np.where(seen[:, None], end - start, 0).astype(now.means.dtype)


def check_times(
    session: DeformationSession, t: float, shutter: Shutter | None = None, motion_dt: float | None = None
) -> None:
    """Raise `InvalidInput`, naming the field, for a time that the scene doesn't have."""
    first, last = session.scene.metadata.time_range
    if shutter is not None and motion_dt is not None:
        raise InvalidInput("shutter", "left out where motion is drawn", "given")
    for field, time in _times(t, shutter, motion_dt):
        if not first <= time <= last:
            expected = f"in the scene's range [{first}, {last}]"
            raise InvalidInput(field, expected if field == "t" else f"such that t + {field} is {expected}", time)


def _times(t: float, shutter: Shutter | None, motion_dt: float | None) -> Iterator[tuple[str, float]]:
    yield "t", t
    if motion_dt is not None:
        yield "dt", t + motion_dt
    if shutter is not None:
        yield "shutter.open", t + shutter.open
        yield "shutter.close", t + shutter.close


def resolve_background(session: DeformationSession, background: Background) -> Color:
    """The color to draw over; black where transparent, which makes the colors premultiplied."""
    if background == "transparent":
        return (0.0, 0.0, 0.0)
    if background == "scene":
        red, green, blue = session.scene.metadata.background
        return (red, green, blue)
    return background

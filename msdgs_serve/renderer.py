"""Render a scene at a time, with a camera, to an image. Independent of HTTP."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from msdgs_serve.deformation import DeformationSession
from msdgs_serve.imaging import Image, average
from msdgs_serve.pose_cache import PoseCache
from msdgs_serve.rasterizer import GSPLAT, RasterizerOptions, as_trained, rasterize
from msdgs_serve.render_job import RenderJob
from msdgs_serve.scene import Camera, Gaussians, InvalidInput, Region
from msdgs_serve.sequence_cache import FixedView, SequenceCache

Color = tuple[float, float, float]
Background = Color | Literal["scene", "transparent"]

DEFAULT_CACHE_BYTES = 256 << 20
DEFAULT_SEQUENCE_BYTES = 128 << 20


@dataclass(frozen=True)
class Shutter:
    """Motion blur over the exposure from `t + open` to `t + close`, in scene time."""

    open: float
    close: float
    samples: int  # frames averaged, at the centers of equal parts of the exposure

    def __post_init__(self) -> None:
        if not self.open < self.close:
            raise InvalidInput("shutter.close", f"after shutter.open, {self.open}", self.close)
        if self.samples < 1:
            raise InvalidInput("shutter.samples", "at least 1", self.samples)

    def times(self, t: float) -> list[float]:
        """Return the times of the samples for a frame at `t`."""
        step = (self.close - self.open) / self.samples
        return [t + self.open + (number + 0.5) * step for number in range(self.samples)]


@dataclass(frozen=True)
class RenderOptions:
    """How a frame is drawn."""

    background: Background = "scene"  # an sRGB-encoded color, the one of training, or none
    shutter: Shutter | None = None  # motion blur; None: a single time
    motion_dt: float | None = None  # also draw motion vectors until t + motion_dt; excludes a shutter
    depth: bool = False  # also draw depth
    counts: bool = False  # also count the Gaussians that contribute to each pixel
    steps: float | None = None  # number of the scene's layers to apply; None: all
    region: Region | None = None  # the part of the camera's image that is drawn; None: all of it
    rasterizer: RasterizerOptions = GSPLAT

    def __post_init__(self) -> None:
        if not isinstance(self.background, str):
            object.__setattr__(self, "background", _color(self.background))
        elif self.background not in ("scene", "transparent"):
            raise InvalidInput("background", "scene, transparent, or a color of three numbers", self.background)
        for name, kind in (("shutter", Shutter), ("region", Region)):
            value = getattr(self, name)
            if value is not None and not isinstance(value, kind):
                raise InvalidInput(name, f"a {kind.__name__}", repr(value))


def _color(values: Sequence[float]) -> Color:
    try:
        red, green, blue = (float(value) for value in values)
    except (TypeError, ValueError):
        raise InvalidInput("background", "scene, transparent, or a color of three numbers", repr(values)) from None
    if not all(0 <= value <= 1 for value in (red, green, blue)):
        raise InvalidInput("background", "a color in [0, 1]", (red, green, blue))
    return red, green, blue


DEFAULT_OPTIONS = RenderOptions()


class Renderer:
    """Renders scenes, caches posed Gaussians, and for cameras that stand still what doesn't move. Safe to use from
    several threads.

    Concurrent requests for the same scene and time pose its Gaussians once.
    """

    def __init__(self, cache_bytes: int = DEFAULT_CACHE_BYTES, sequence_bytes: int = DEFAULT_SEQUENCE_BYTES) -> None:
        self.cache = PoseCache(cache_bytes)
        self.sequences = SequenceCache(sequence_bytes)

    def render(
        self,
        session: DeformationSession,
        camera: Camera,
        t: float,
        options: RenderOptions = DEFAULT_OPTIONS,
        job: RenderJob | None = None,
    ) -> Image:
        """Return the frame that `camera`, in the user's world, sees at `t`. Equal arguments give equal pixels.

        `job` times the stages `pose` and `draw`.

        Raises:
            InvalidInput: if `t`, the shutter or `steps` are outside the scene's range, or its plan has no motion.
            RenderCancelled: if the job was cancelled.
            SceneFileInvalid: if the scene's Gaussians at that time are not valid.
        """
        job = job or RenderJob()
        check_times(session, t, options.shutter, options.motion_dt)
        if options.shutter is None:
            return self._render_at(session, camera, t, t, options, job)
        times = options.shutter.times(t)
        return average(self._render_at(session, camera, t, time, options, job) for time in times)

    def posed(
        self, session: DeformationSession, t: float, job: RenderJob | None = None, steps: float | None = None
    ) -> Gaussians:
        """Return the scene's Gaussians at `t`, from the cache if possible."""
        return self.cache.get(session, t, job or RenderJob(), steps)

    def _render_at(
        self,
        session: DeformationSession,
        camera: Camera,
        t: float,
        time: float,
        options: RenderOptions,
        job: RenderJob,
    ) -> Image:
        gaussians, later = self.posed(session, time, job, options.steps), None
        if options.motion_dt is not None:
            later = self.posed(session, session.later(time, options.motion_dt), job, options.steps)
        with job.stage("draw"), session.as_scene_file_error(time):
            background = resolve_background(session, options.background)
            constants = as_trained(session.scene.metadata, options.rasterizer)
            place = session.scene.metadata.scene_to_world
            seen_from = place.camera_to_scene(camera)
            extra = None if later is None else displacements(gaussians, later, seen_from)
            drawn = None
            if extra is None and not options.counts:
                view = FixedView(seen_from, background, options.depth, constants, options.region)
                drawn = self.sequences.frame(session, gaussians, view)
            if drawn is None:
                drawn = rasterize(
                    gaussians,
                    seen_from,
                    background=background,
                    depth=options.depth,
                    extra=extra,
                    counts=options.counts,
                    options=constants,
                    region=options.region,
                    static=session.scene.static_bounds,
                )
            transparent = options.background == "transparent"
            motion = None if extra is None else drawn.extra / np.where(drawn.alpha > 0, drawn.alpha, 1)[..., None]
            counts = drawn.counts if options.counts else None
            depth = in_world_units(drawn.depth, place.scale) if options.depth else None
            return Image(
                drawn.rgb, drawn.alpha, depth, transparent, camera, t, motion, options.motion_dt, counts, options.region
            )


def in_world_units(depth: np.ndarray, scale: float) -> np.ndarray:
    """Return depths of the scene's frame, float32, in units of the world."""
    return depth if scale == 1.0 else depth * np.float32(scale)


def displacements(now: Gaussians, later: Gaussians, camera: Camera) -> np.ndarray:
    """Return the displacement of each center in the image of `camera`, [N, 2] pixels to the right and down.

    It is 0 for Gaussians that are behind the near plane at one of the times.
    """
    (start, start_depths), (end, end_depths) = camera.project(now.means), camera.project(later.means)
    seen = (start_depths > GSPLAT.near_plane) & (end_depths > GSPLAT.near_plane)
    return np.where(seen[:, None], end - start, 0).astype(now.means.dtype)


def check_times(
    session: DeformationSession, t: float, shutter: Shutter | None = None, motion_dt: float | None = None
) -> None:
    """Raise `InvalidInput`, naming the field, for times outside the scene's range, or motion of switched frames."""
    if shutter is not None and motion_dt is not None:
        raise InvalidInput("shutter", "left out if motion is drawn", "given")
    if motion_dt is not None and session.scene.metadata.is_switched:
        raise InvalidInput("dt", "left out: this scene switches from frame to frame, nothing moves", motion_dt)
    session.check_time(t)
    if motion_dt is not None:
        session.check_time(session.later(t, motion_dt), "dt")
    if shutter is not None:
        session.check_time(session.later(t, shutter.open), "shutter.open")
        session.check_time(session.later(t, shutter.close), "shutter.close")


def resolve_background(session: DeformationSession, background: Background) -> Color:
    """Return the background color; black if transparent, which gives premultiplied colors."""
    if background == "transparent":
        return (0.0, 0.0, 0.0)
    if background == "scene":
        red, green, blue = session.scene.metadata.background
        return (red, green, blue)
    return background

"""Plan and render the frames of a request, from its values to the encoded file and the response headers."""

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated, TypeVar
from urllib.parse import quote

import numpy as np
from fastapi import Header

from msdgs_serve import __version__
from msdgs_serve.api.cameras import resolve_camera
from msdgs_serve.api.schemas import RenderRequest
from msdgs_serve.api.service import Service
from msdgs_serve.imaging import FORMATS, Channel, DepthRange, Image, encode
from msdgs_serve.imaging.encode import check_encodable, npy, numbers
from msdgs_serve.imaging.formats import default_channels
from msdgs_serve.render_job import RenderJob
from msdgs_serve.renderer import Background, RenderOptions, Shutter, check_times
from msdgs_serve.scene import Camera, InvalidInput, Region
from msdgs_serve.store import ServedScene

IfNoneMatch = Annotated[
    str | None, Header(max_length=8192, description="`ETag`s of the client's cached versions", examples=['"0123"'])
]
Result = TypeVar("Result")


@dataclass(frozen=True)
class FramePlan:
    """A checked request with everything needed to render it."""

    request: RenderRequest
    scene: ServedScene
    camera: Camera
    times: Sequence[float]
    options: RenderOptions
    channels: Sequence[Channel]
    depth_range: DepthRange | None
    etag: str

    @property
    def media_type(self) -> str:
        """Media type of the response."""
        return FORMATS[self.request.format].media_type

    def headers(self, max_age: int, *, needs_key: bool = False) -> dict[str, str]:
        """Return the response headers, which don't depend on the rendering."""
        error = _worst_decibels(self.scene)
        caches = "private" if needs_key else "public"
        return {
            "ETag": self.etag,
            "Cache-Control": f"{caches}, max-age={max_age}" if max_age else "no-cache",
            **({"Vary": "Authorization, X-API-Key"} if needs_key else {}),
            "Msdgs-Scene": quote(self.scene.name),
            "Msdgs-Plan": self.scene.session.scene.metadata.plan,
            "Msdgs-Channels": ",".join(self.channels),
            **({} if error is None else {"Msdgs-Error": f"{error:.2f}"}),
        }


def plan_frame(service: Service, request: RenderRequest) -> FramePlan:
    """Check a request and return its plan; may load the scene. Raises `MsdgsError`."""
    scene = service.scene(request.scene)
    camera = resolve_camera(request, scene)
    times = request.t if isinstance(request.t, list) else [request.t]
    region = None if request.region is None else Region(*request.region)
    if region is not None:
        region.check(camera)
    size = camera if region is None else region
    _check_amounts(service, request, size, len(times))
    background = _background(request)
    transparent = background == "transparent"
    check_encodable(size.width, size.height, transparent, request.format, request.quality, request.channels)
    shutter = None
    if request.shutter is not None:
        shutter = Shutter(request.shutter.open, request.shutter.close, request.shutter.samples)
    channels = request.channels or default_channels(request.format)
    if region is not None and not FORMATS[request.format].holds_float:
        _check_seamless(request, channels[0])
    if ("motion" in channels) != (request.dt is not None):
        expected = "given for the channel motion" if request.dt is None else "left out without the channel motion"
        raise InvalidInput("dt", expected, "nothing" if request.dt is None else request.dt)
    for t in times:
        check_times(scene.session, t, shutter, request.dt)
    scene.session.check_steps(request.steps)
    options = RenderOptions(
        background,
        shutter,
        request.dt,
        depth="depth" in channels,
        counts="gaussians" in channels,
        steps=request.steps,
        region=region,
    )
    etag = _etag(scene, request)
    return FramePlan(request, scene, camera, times, options, channels, _depth_range(request, channels), etag)


def draw_frame(service: Service, plan: FramePlan, t: float, job: RenderJob) -> bytes:
    """Return the file of one frame. Stages of the job: `pose`, `draw` and `encode`."""
    image = _draw(service, plan, t, job)
    with job.stage("encode"):
        return encode(image, plan.request.format, plan.request.quality, plan.channels, plan.depth_range)


async def draw_plan(service: Service, plan: FramePlan, job: RenderJob) -> bytes:
    """Render a plan through the queue and return its file; each of several times is queued as a part.

    The stages of each frame are counted in the metrics, and added up in `job`.
    """
    if not isinstance(plan.request.t, list):
        return await _queued(service, partial(draw_frame, service, plan, plan.times[0]), job, part=False)
    draw = partial(_draw_numbers, service, plan)
    arrays = [await _queued(service, partial(draw, t), job, part=True) for t in plan.times]
    return await service.queue.run(lambda: npy(np.stack(arrays)), job, part=True)


async def _queued(service: Service, draw: Callable[[RenderJob], Result], total: RenderJob, *, part: bool) -> Result:
    job = RenderJob()
    drawn = await service.queue.run(partial(draw, job), job, part=part)
    service.metrics.count_stages(job.seconds)
    for stage, seconds in job.seconds.items():
        total.add(stage, seconds)
    total.notes.update(job.notes)
    return drawn


def _draw(service: Service, plan: FramePlan, t: float, job: RenderJob) -> Image:
    return service.renderer.render(plan.scene.session, plan.camera, t, plan.options, job)


def _draw_numbers(service: Service, plan: FramePlan, t: float, job: RenderJob) -> np.ndarray:
    return numbers(_draw(service, plan, t, job), plan.channels)


def server_timing(job: RenderJob) -> str:
    """Return the `Server-Timing` header: milliseconds by stage, and whether the pose was cached."""
    notes = {stage: f';desc="{note}"' for stage, note in job.notes.items()}
    return ", ".join(f"{stage};dur={1000 * s:.2f}{notes.get(stage, '')}" for stage, s in job.seconds.items())


def is_unchanged(if_none_match: str | None, etag: str) -> bool:
    """Whether `If-None-Match` includes this version."""
    if if_none_match is None:
        return False
    known = [tag.strip().removeprefix("W/") for tag in if_none_match.split(",")]
    return etag in known or "*" in known


def _etag(scene: ServedScene, request: RenderRequest) -> str:
    """Return the ETag of scene file, request and program version."""
    asked = request.model_dump(mode="json", exclude={"scene"}, exclude_defaults=True)
    text = json.dumps([__version__, scene.sha256, asked], sort_keys=True)
    return f'"{hashlib.sha256(text.encode()).hexdigest()[:32]}"'


def _worst_decibels(scene: ServedScene) -> float | None:
    """Return the file's measured PSNR of the worst frame against the full model, or None."""
    rendered = scene.session.scene.metadata.measured_error.get("rendered")
    value = rendered.get("psnr_worst") if isinstance(rendered, dict) else None
    return float(value) if isinstance(value, int | float) else None


def _check_seamless(request: RenderRequest, channel: Channel) -> None:
    """Raise `InvalidInput` for a display image whose brightness depends on the whole image."""
    if channel == "depth" and request.depth_range is None:
        raise InvalidInput("depth_range", "given with region, whose nearest and farthest depths vary", "nothing")
    if channel in ("motion", "gaussians"):
        expected = f"left out for {channel} as {request.format}, which is relative to the largest value; use exr or npy"
        raise InvalidInput("region", expected, list(request.region or ()))


def _check_amounts(service: Service, request: RenderRequest, size: Camera | Region, frames: int) -> None:
    limits = service.settings
    if isinstance(request.t, list) and request.format != "npy":
        expected = "one time, except for `npy`; `POST /render/batch` renders many frames"
        raise InvalidInput("t", expected, f"a list for `{request.format}`")
    if frames > limits.max_batch:
        raise InvalidInput("t", f"a list of at most {limits.max_batch} times", frames)
    if request.shutter is not None and request.shutter.samples > limits.max_samples:
        raise InvalidInput("shutter.samples", f"at most {limits.max_samples}", request.shutter.samples)
    check_pixels(size, frames, limits.max_pixels, limits.max_pixels, "t")


def check_pixels(size: Camera | Region, frames: int, limit: int, total: int, field: str) -> None:
    """Raise `InvalidInput` for more than `limit` pixels per frame or more than `total` pixels in all frames."""
    pixels, got = size.width * size.height, f"{size.width} × {size.height}"
    if pixels > limit:
        larger = "width" if size.width >= size.height else "height"
        name = "region" if isinstance(size, Region) else larger
        raise InvalidInput(name, f"such that width × height is at most {limit} pixels", got)
    if pixels * frames > total:
        expected = f"such that width × height × number of frames is at most {total} pixels"
        raise InvalidInput(field, expected, f"{frames} of {got}")


def _background(request: RenderRequest) -> Background:
    if request.background == "auto":
        return "transparent" if FORMATS[request.format].holds_float else "scene"
    return request.background or "transparent"


def _depth_range(request: RenderRequest, channels: Sequence[Channel]) -> DepthRange | None:
    if request.depth_range is None:
        return None
    if FORMATS[request.format].holds_float or "depth" not in channels:
        raise InvalidInput("depth_range", "left out unless depth is drawn as png, jpeg or webp", "given")
    near, far = request.depth_range
    if not near < far:
        raise InvalidInput("depth_range", "two depths in increasing order", [near, far])
    return DepthRange(near, far)

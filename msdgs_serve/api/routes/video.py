"""Render a video along a camera path."""

from collections.abc import AsyncGenerator, Iterator
from contextlib import aclosing, contextmanager
from functools import partial
from typing import BinaryIO, cast
from urllib.parse import quote

import anyio.to_thread
from fastapi import APIRouter, Request
from fastapi.responses import Response, StreamingResponse

from msdgs_serve.api.cameras import resolve_camera
from msdgs_serve.api.frames import check_pixels
from msdgs_serve.api.openapi import VIDEO_RESPONSE, problems
from msdgs_serve.api.schemas import RenderRequest, VideoRequest
from msdgs_serve.api.service import Service, SharedService
from msdgs_serve.api.work import unless_gone
from msdgs_serve.camera_path import DEFAULT_FPS, CameraPath, read_nerfstudio
from msdgs_serve.render_job import RenderJob
from msdgs_serve.renderer import RenderOptions, check_times
from msdgs_serve.scene import Camera, InvalidInput
from msdgs_serve.store import ServedScene
from msdgs_serve.video import VIDEO_FORMATS, VideoWriter, require_pyav

MAX_HEADER = 1000  # characters
PRINTABLE = "".join(map(chr, range(32, 127)))

router = APIRouter(tags=["frames"])


@router.post(
    "/render/video",
    summary="A video along a camera path",
    response_class=Response,
    responses={**VIDEO_RESPONSE, **problems(400, 404, 408, 413, 415, 422, 501, 503, 504)},
)
async def render_video(body: VideoRequest, service: SharedService, request: Request) -> Response:
    """Streams the video while its frames are rendered, with renders of other requests in between. The time limit holds
    per frame; if one fails, the connection is closed, so that the client knows that the video is incomplete.

    For long videos use `msdgs-render` on the machine itself, which shows its progress and can be resumed.
    """
    require_pyav(body.format)
    scene, path = await anyio.to_thread.run_sync(_path, service, body)
    stream = _stream_video(service, body, scene, path)
    first = await unless_gone(request, anext(stream))  # an error in the first frame still gets its status
    headers = {"Msdgs-Warning": quote("; ".join(path.warnings)[:MAX_HEADER], safe=PRINTABLE)} if path.warnings else None
    return StreamingResponse(_joined(first, stream), headers=headers, media_type=VIDEO_FORMATS[body.format].media_type)


class _OutputBuffer:
    """A write-only file whose new contents are taken piece by piece."""

    def __init__(self) -> None:
        self._pieces: list[bytes] = []

    def write(self, data: bytes) -> int:
        self._pieces.append(bytes(data))
        return len(data)

    def take(self) -> bytes:
        taken = b"".join(self._pieces)
        self._pieces.clear()
        return taken


async def _stream_video(
    service: Service, body: VideoRequest, scene: ServedScene, path: CameraPath
) -> AsyncGenerator[bytes]:
    """Yield the file in pieces. Each frame is rendered when its turn comes and the previous piece was sent."""
    options, unsent = RenderOptions(body.background), _OutputBuffer()
    writer = VideoWriter(cast(BinaryIO, unsent), body.fps or path.fps, body.format)

    def add(camera: Camera, t: float, job: RenderJob) -> bytes:
        pixels = service.renderer.render(scene.session, camera, t, options, job).display_pixels()
        with job.stage("encode"):
            writer.add(pixels)
        return unsent.take()

    def close() -> bytes:
        writer.close()
        return unsent.take()

    for camera, t in path.frames:
        job = RenderJob()
        piece = await service.queue.run(partial(add, camera, t, job), job, part=True)
        service.metrics.count_stages(job.seconds)
        yield piece
    yield await service.queue.run(close, RenderJob(), part=True)


async def _joined(first: bytes, rest: AsyncGenerator[bytes]) -> AsyncGenerator[bytes]:
    async with aclosing(rest):
        if first:
            yield first
        async for piece in rest:
            if piece:
                yield piece


def _path(service: Service, body: VideoRequest) -> tuple[ServedScene, CameraPath]:
    scene = service.scene(body.scene)
    if (body.frames is None) == (body.path is None):
        raise InvalidInput("frames", "given, or path", "neither" if body.frames is None else "both")
    if (body.width is None) != (body.height is None):
        raise InvalidInput("width", "given together with height", "only one of them")
    size = None if body.width is None or body.height is None else (body.width, body.height)
    if body.path is not None:
        with _named_in("path"):
            times = scene.session.scene.metadata.time_range
            path = read_nerfstudio(body.path.model_dump(exclude_none=True), times, size)
    else:
        width, height, frames = body.width, body.height, []
        for number, each in enumerate(body.frames or ()):
            with _named_in(f"frames.{number}"):
                check_times(scene.session, each.t)
                request = RenderRequest(camera=each.camera, t=each.t, width=width, height=height)
                camera = resolve_camera(request, scene)
            width, height = camera.width, camera.height  # those of the first frame
            frames.append((camera, each.t))
        path = CameraPath(tuple(frames), DEFAULT_FPS)
    field, limits = "frames" if body.path is None else "path.camera_path", service.settings
    if len(path.frames) > limits.max_video_frames:
        raise InvalidInput(field, f"at most {limits.max_video_frames}", len(path.frames))
    try:
        check_pixels(path.frames[0][0], len(path.frames), limits.max_pixels, limits.max_video_pixels, field)
    except InvalidInput as error:
        is_size_of_path = error.field != field and body.path is not None and size is None
        raise (error.renamed(f"path.render_{error.field}") if is_size_of_path else error) from None
    return scene, path


@contextmanager
def _named_in(place: str) -> Iterator[None]:
    """Name the field of an error by its place in the request, unless it is the size, which all frames share."""
    try:
        yield
    except InvalidInput as error:
        raise (error if error.field in ("width", "height") else error.renamed(f"{place}.{error.field}")) from None

"""Many frames in one call, each with a response of its own."""

import base64
import json
import re
from collections.abc import AsyncGenerator, AsyncIterator
from contextlib import aclosing
from dataclasses import dataclass, field, replace
from functools import partial
from http import HTTPStatus
from typing import Annotated, Any

import anyio.to_thread
from fastapi import APIRouter, Header
from fastapi.responses import StreamingResponse
from pydantic import ValidationError

from msdgs_serve.api.errors import MEDIA_TYPE as PROBLEM
from msdgs_serve.api.errors import problem_of
from msdgs_serve.api.frames import FramePlan, draw_frame, plan_frame, server_timing
from msdgs_serve.api.openapi import BATCH_RESPONSE, problems
from msdgs_serve.api.schemas import BatchItem, BatchRequest, RenderRequest
from msdgs_serve.api.service import Service, SharedService
from msdgs_serve.render_job import RenderJob
from msdgs_serve.scene import InvalidInput, MsdgsError

BOUNDARY = "msdgs-frame"
NDJSON = "application/x-ndjson"
MULTIPART = "multipart/mixed"

router = APIRouter(tags=["frames"])


@dataclass(frozen=True)
class Item:
    """One frame of a batch, or its problem."""

    index: int
    status: int
    body: bytes  # the image, in base64 for a JSON line; or the problem
    media_type: str = PROBLEM
    headers: dict[str, str] = field(default_factory=dict)  # of an image


@dataclass(frozen=True)
class _Equal:
    """Checked frames that are equal. They keep no scene in memory."""

    request: RenderRequest
    scene: str
    t: float
    indices: list[int]


@router.post(
    "/render/batch",
    summary="Many frames",
    response_class=StreamingResponse,
    responses={**BATCH_RESPONSE, **problems(400, 408, 413, 415, 422, 503)},
)
async def render_batch(
    body: BatchRequest, service: SharedService, accept: Annotated[str | None, Header(max_length=1000)] = None
) -> StreamingResponse:
    """Streams the frames as they are ready, as one JSON object per line, or as `multipart/mixed` if that is accepted.

    A frame that fails has a problem instead of an image; the others are rendered. Equal frames are rendered once, and
    frames of one time are posed once. The time limit holds per frame.
    """
    if len(body.frames) > service.settings.max_batch:
        raise InvalidInput("frames", f"at most {service.settings.max_batch}", len(body.frames))
    multipart = 0 < _weight(accept or "", MULTIPART) >= _weight(accept or "", NDJSON)
    media_type = f"{MULTIPART}; boundary={BOUNDARY}" if multipart else NDJSON
    return StreamingResponse(_written(service, body.frames, multipart), media_type=media_type)


def _weight(accept: str, media_type: str) -> float:
    """The weight that a header `Accept` gives a media type (RFC 9110, section 12.4.2); 0 if it doesn't name it."""
    for entry in accept.lower().split(","):
        name, *parameters = (part.strip() for part in entry.split(";"))
        if name == media_type:
            weight = next((text[2:] for text in parameters if text.startswith("q=")), "1")
            return float(weight) if re.fullmatch(r"[01](\.\d{0,3})?", weight) else 0.0
    return 0.0


async def _written(service: Service, frames: list[dict[str, Any]], multipart: bool) -> AsyncIterator[bytes]:
    async with aclosing(_items(service, frames, multipart)) as items:
        async for item in items:
            yield _part(item) if multipart else _line(item)
    if multipart:
        yield f"--{BOUNDARY}--\r\n".encode()


async def _items(service: Service, frames: list[dict[str, Any]], multipart: bool) -> AsyncGenerator[Item]:
    """Yield invalid frames first, then the others sorted by scene and time, equal ones together.

    A frame is rendered when the previous one was sent.
    """
    checked: dict[str, _Equal] = {}
    for index, frame in enumerate(frames):
        try:
            etag, equal = await anyio.to_thread.run_sync(_checked, service, frame)
        except (MsdgsError, ValidationError) as error:
            yield _failed(index, error)
        else:
            checked.setdefault(etag, equal).indices.append(index)
    for equal in sorted(checked.values(), key=lambda each: (each.scene, each.t)):
        try:
            item = await _rendered(service, equal, multipart)
        except Exception as error:
            for index in equal.indices:
                yield _failed(index, error)
            continue
        for index in equal.indices:
            yield replace(item, index=index)


def _checked(service: Service, frame: dict[str, Any]) -> tuple[str, _Equal]:
    """Return the ETag of a valid frame, and what is needed to render it."""
    request = RenderRequest.model_validate(frame)
    if isinstance(request.t, list):
        raise InvalidInput("t", "a single time; use one frame per time", "a list")
    plan = plan_frame(service, request)
    return plan.etag, _Equal(request, plan.scene.name, request.t, [])


async def _rendered(service: Service, equal: _Equal, multipart: bool) -> Item:
    """Render the first of equal frames. The scene, which may have been unloaded since the check, is free afterwards."""
    plan, job = await anyio.to_thread.run_sync(plan_frame, service, equal.request), RenderJob()
    image = await service.queue.run(partial(_drawn, service, plan, job, multipart), job, part=True)
    service.metrics.count_stages(job.seconds)
    headers = plan.headers(0) | {"Server-Timing": server_timing(job)}
    return Item(equal.indices[0], HTTPStatus.OK, image, plan.media_type, headers)


def _drawn(service: Service, plan: FramePlan, job: RenderJob, multipart: bool) -> bytes:
    """Render a frame, and encode it in base64 here: on the event loop that would delay all other calls."""
    image = draw_frame(service, plan, plan.times[0], job)
    return image if multipart else base64.b64encode(image)


def _failed(index: int, error: Exception) -> Item:
    status, body = problem_of(error)
    return Item(index, status, body)


def _line(item: Item) -> bytes:
    line = BatchItem(index=item.index, status=item.status)
    if item.media_type == PROBLEM:
        line.problem = json.loads(item.body)
        return line.model_dump_json(exclude_none=True).encode() + b"\n"
    line.media_type = item.media_type
    head = line.model_dump_json(exclude_none=True).encode().removesuffix(b"}")
    return b"".join((head, b',"data":"', item.body, b'"}\n'))


def _part(item: Item) -> bytes:
    head = {"Content-Type": item.media_type, "Content-Length": str(len(item.body)), **item.headers}
    head |= {"Msdgs-Index": str(item.index), "Msdgs-Status": str(item.status)}
    lines = "".join(f"{name}: {value}\r\n" for name, value in head.items())
    return f"--{BOUNDARY}\r\n{lines}\r\n".encode() + item.body + b"\r\n"

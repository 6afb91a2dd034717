"""Many frames in one call, each with a response of its own."""

import base64
import json
from collections.abc import AsyncGenerator, AsyncIterator
from contextlib import aclosing
from functools import partial
from http import HTTPStatus
from typing import Annotated, Any

import anyio.to_thread
from fastapi import APIRouter, Header
from fastapi.responses import StreamingResponse
from pydantic import ValidationError

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


class Item:
    """One frame of a batch, or its problem."""

    def __init__(self, index: int, status: int, *, plan: FramePlan | None = None, body: bytes = b"") -> None:
        self.index = index
        self.status = status
        self.plan = plan
        self.body = body  # the image, in base64 for a JSON line; or the problem if there is no plan
        self.timing = ""


@router.post(
    "/render/batch",
    summary="Many frames",
    response_class=StreamingResponse,
    responses={**BATCH_RESPONSE, **problems(400, 408, 413, 422, 503)},
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
    multipart = MULTIPART in (accept or "")
    media_type = f"{MULTIPART}; boundary={BOUNDARY}" if multipart else NDJSON
    return StreamingResponse(_written(service, body.frames, multipart), media_type=media_type)


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
    planned: dict[str, list[tuple[int, FramePlan]]] = {}
    for index, frame in enumerate(frames):
        try:
            plan = await anyio.to_thread.run_sync(_plan, service, frame)
        except (MsdgsError, ValidationError) as error:
            yield _failed(index, error)
        else:
            planned.setdefault(plan.etag, []).append((index, plan))
    for same in sorted(planned.values(), key=lambda plans: (plans[0][1].scene.name, plans[0][1].times[0])):
        plan, job = same[0][1], RenderJob()
        try:
            work = partial(_drawn, service, plan, job, multipart)
            image = await service.queue.run(work, job, part=True)
        except Exception as error:
            for index, _ in same:
                yield _failed(index, error)
            continue
        service.metrics.count_stages(job.seconds)
        for index, _ in same:
            item = Item(index, HTTPStatus.OK, plan=plan, body=image)
            item.timing = server_timing(job)
            yield item


def _drawn(service: Service, plan: FramePlan, job: RenderJob, multipart: bool) -> bytes:
    """Render a frame, and encode it in base64 here: on the event loop that would delay all other calls."""
    image = draw_frame(service, plan, plan.times[0], job)
    return image if multipart else base64.b64encode(image)


def _plan(service: Service, frame: dict[str, Any]) -> FramePlan:
    request = RenderRequest.model_validate(frame)
    if isinstance(request.t, list):
        raise InvalidInput("t", "a single time; use one frame per time", "a list")
    return plan_frame(service, request)


def _failed(index: int, error: Exception) -> Item:
    status, body = problem_of(error)
    return Item(index, status, body=body)


def _line(item: Item) -> bytes:
    line = BatchItem(index=item.index, status=item.status)
    if item.plan is None:
        line.problem = json.loads(item.body)
        return line.model_dump_json(exclude_none=True).encode() + b"\n"
    line.media_type = item.plan.media_type
    head = line.model_dump_json(exclude_none=True).encode().removesuffix(b"}")
    return b"".join((head, b',"data":"', item.body, b'"}\n'))


def _part(item: Item) -> bytes:
    head = {"Content-Type": "application/problem+json", "Content-Length": str(len(item.body))}
    if item.plan is not None:
        head |= {**item.plan.headers(0), "Content-Type": item.plan.media_type, "Server-Timing": item.timing}
    head |= {"Msdgs-Index": str(item.index), "Msdgs-Status": str(item.status)}
    lines = "".join(f"{name}: {value}\r\n" for name, value in head.items())
    return f"--{BOUNDARY}\r\n{lines}\r\n".encode() + item.body + b"\r\n"

"""Render a frame."""

from collections.abc import Callable
from http import HTTPStatus
from typing import Annotated

import anyio.to_thread
from fastapi import APIRouter, Query, Request
from fastapi.responses import Response

from msdgs_serve.api.frames import FramePlan, IfNoneMatch, draw_plan, is_unchanged, plan_frame, server_timing
from msdgs_serve.api.openapi import IMAGE_RESPONSE, NOT_MODIFIED, problems
from msdgs_serve.api.queries import by_parameter, refuse_repeated, request_of
from msdgs_serve.api.schemas import RenderQuery, RenderRequest
from msdgs_serve.api.service import Service, SharedService
from msdgs_serve.api.work import unless_gone
from msdgs_serve.render_job import RenderJob
from msdgs_serve.scene import InvalidInput

RESPONSES = {**IMAGE_RESPONSE, **NOT_MODIFIED, **problems(400, 404, 408, 413, 415, 422, 503, 504)}

router = APIRouter(tags=["frames"])


@router.post("/render", summary="A frame, for any camera and any time", response_class=Response, responses=RESPONSES)
async def render(
    body: RenderRequest, service: SharedService, request: Request, if_none_match: IfNoneMatch = None
) -> Response:
    """Renders the scene with `camera` at `t` and returns the image file.

    Equal bodies give equal bytes while the scene's file is unchanged, which `ETag` identifies. `Server-Timing` has the
    times of the stages, `Msdgs-Plan` the way in which the scene's motion is computed.
    """
    return await answer(service, request, lambda: plan_frame(service, body), if_none_match)


@router.get("/render", summary="A frame as a link", response_class=Response, responses=RESPONSES)
async def render_link(
    query: Annotated[RenderQuery, Query()],
    service: SharedService,
    request: Request,
    if_none_match: IfNoneMatch = None,
) -> Response:
    """The same for browsers and proxies: `/render?azimuth=30&t=0.5`. The default camera is an orbit view."""

    def plan() -> FramePlan:
        refuse_repeated(request.query_params)
        body = request_of(query, service.scene(query.scene).session.scene.metadata)
        try:
            return plan_frame(service, body)
        except InvalidInput as error:
            raise by_parameter(error) from None

    return await answer(service, request, plan, if_none_match)


async def answer(
    service: Service, request: Request, make_plan: Callable[[], FramePlan], if_none_match: str | None
) -> Response:
    """Render a plan, unless the client has the frame already or disconnects."""
    plan, settings = await anyio.to_thread.run_sync(make_plan), service.settings
    headers = plan.headers(settings.frame_max_age, needs_key=settings.api_keys_file is not None)
    if is_unchanged(if_none_match, plan.etag):
        return Response(status_code=HTTPStatus.NOT_MODIFIED, headers=headers)
    job = RenderJob()
    image = await unless_gone(request, draw_plan(service, plan, job))
    headers["Server-Timing"] = server_timing(job)
    return Response(image, media_type=plan.media_type, headers=headers)

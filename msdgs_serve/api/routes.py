"""The calls of the service. What takes long is done off the event loop."""

from dataclasses import dataclass
from http import HTTPStatus
from typing import Annotated

import anyio
import anyio.to_thread
from fastapi import APIRouter, Depends, Path, Request
from fastapi.responses import Response

from msdgs_serve import __version__
from msdgs_serve.api.cameras import resolve_camera
from msdgs_serve.api.openapi import IMAGE_RESPONSE, problems
from msdgs_serve.api.schemas import GaussianCounts, Health, RenderRequest, SceneDetail, SceneEntry, SceneList
from msdgs_serve.imaging import FORMATS, encode
from msdgs_serve.imaging.encode import check_encodable
from msdgs_serve.renderer import Background, Renderer, RenderOptions
from msdgs_serve.scene import Camera, InvalidInput
from msdgs_serve.store import MAX_NAME_LENGTH, SceneStore


@dataclass(frozen=True)
class Service:
    """What the calls share."""

    store: SceneStore
    renderer: Renderer
    max_pixels: int
    slots: anyio.CapacityLimiter  # one for each frame in work


def _service(request: Request) -> Service:
    return request.app.state.service


SharedService = Annotated[Service, Depends(_service)]
SceneName = Annotated[str, Path(max_length=MAX_NAME_LENGTH, description="as in `GET /scenes`")]

router = APIRouter()


@router.post(
    "/render",
    summary="A frame, for any camera and any time",
    response_class=Response,
    responses={
        **IMAGE_RESPONSE,
        **problems(
            HTTPStatus.NOT_FOUND,
            HTTPStatus.REQUEST_ENTITY_TOO_LARGE,
            HTTPStatus.UNPROCESSABLE_ENTITY,
            HTTPStatus.SERVICE_UNAVAILABLE,
        ),
    },
)
async def render(body: RenderRequest, service: SharedService) -> Response:
    """Draws the scene as `camera` sees it at `t` and answers with the image file.

    The same body gives the same bytes, as long as the scene's file stays the same.
    """
    image = await anyio.to_thread.run_sync(_render, service, body, limiter=service.slots)
    return Response(image, media_type=FORMATS[body.format].media_type)


@router.get("/scenes", summary="The scenes that are served", responses=problems(HTTPStatus.UNPROCESSABLE_ENTITY))
def list_scenes(service: SharedService) -> SceneList:
    """Names, without loading anything."""
    statuses = [service.store.status(name) for name in service.store.names()]
    return SceneList(
        scenes=[SceneEntry(name=each.name, loaded=each.loaded, problem=each.problem is not None) for each in statuses]
    )


@router.get(
    "/scenes/{name}",
    summary="What a scene is",
    responses=problems(HTTPStatus.NOT_FOUND, HTTPStatus.UNPROCESSABLE_ENTITY, HTTPStatus.SERVICE_UNAVAILABLE),
)
def describe_scene(name: SceneName, service: SharedService) -> SceneDetail:
    """Time range, cameras to start from, plan, counts and measured error. Loads the scene if it isn't yet."""
    return _describe(service.store, name)


@router.get("/healthz", summary="Whether the service runs")
async def health() -> Health:
    """Answers as long as the process does; looks at no scene."""
    return Health(version=__version__)


def _render(service: Service, body: RenderRequest) -> bytes:
    session = service.store.get(_scene_name(body.scene, service.store))
    camera = resolve_camera(body, session.scene.metadata)
    _check_pixels(camera, service.max_pixels)
    background = _background(body)
    check_encodable(camera.width, camera.height, background == "transparent", body.format, body.quality)
    image = service.renderer.render(session, camera, body.t, RenderOptions(background))
    return encode(image, body.format, body.quality)


def _scene_name(name: str | None, store: SceneStore) -> str:
    if name is not None:
        return name
    names = store.names()
    if len(names) != 1:
        raise InvalidInput("scene", f"given, as {len(names)} scenes are served", "nothing")
    return names[0]


def _check_pixels(camera: Camera, limit: int) -> None:
    if camera.width * camera.height > limit:
        size = f"{camera.width} × {camera.height}"
        larger = "width" if camera.width >= camera.height else "height"
        raise InvalidInput(larger, f"such that width × height is at most {limit} pixels", size)


def _background(body: RenderRequest) -> Background:
    if body.background == "auto":
        return "transparent" if body.format == "exr" else "scene"
    return body.background or "transparent"


def _describe(store: SceneStore, name: str) -> SceneDetail:
    scene = store.get(name).scene
    status = store.status(name)
    metadata = scene.metadata
    low, high = metadata.bounds
    counts = GaussianCounts(moving=scene.moving_count, static=scene.static_count, total=len(scene))
    return SceneDetail(
        name=name,
        loaded=status.loaded,
        problem=status.problem is not None,
        contract=metadata.contract,
        plan=metadata.plan,
        layers=list(metadata.layers),
        gaussians=counts,
        sh_degree=metadata.sh_degree,
        time_range=metadata.time_range,
        bounds=(list(low), list(high)),
        background=metadata.background,
        antialiasing=metadata.antialiasing,
        delta_space=metadata.delta_space,
        cameras=[camera.to_plain() for camera in metadata.cameras],
        measured_error=metadata.measured_error,
        left_out=list(metadata.left_out),
        package_version=metadata.package_version,
        checkpoint_sha256=metadata.checkpoint_sha256,
    )

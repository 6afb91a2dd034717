"""List, describe, download, add and delete scenes."""

import asyncio
import hashlib
import hmac
import uuid
from collections.abc import AsyncIterator, Collection
from functools import partial
from http import HTTPStatus
from pathlib import Path as FilePath
from typing import Annotated, Any
from urllib.parse import quote

import anyio
import anyio.to_thread
from fastapi import APIRouter, Path, Query, Request, Response
from starlette.requests import ClientDisconnect

from msdgs_serve.api.downloads import SceneFileResponse, file_headers
from msdgs_serve.api.errors import ClientGone, RequestRejected
from msdgs_serve.api.frames import IfNoneMatch, is_unchanged
from msdgs_serve.api.keys import CLIENT
from msdgs_serve.api.numbers import Name
from msdgs_serve.api.openapi import FILE_RESPONSE, NOT_MODIFIED, SCENE_BODY, problems
from msdgs_serve.api.schemas import GraphCost, SceneAdded, SceneDetail, SceneEntry, SceneList
from msdgs_serve.api.service import Service, SharedService
from msdgs_serve.api.uploads import Stored
from msdgs_serve.description import described
from msdgs_serve.scene import InvalidInput, SceneFileInvalid
from msdgs_serve.scene_report import has_report, read_report
from msdgs_serve.store import SceneStatus, SceneStore

MAX_REASON = 300

SceneName = Annotated[Name, Path(description="name of a scene, see `GET /scenes`", examples=["toys"])]
NewName = Annotated[Name, Query(description="printable text without separators", examples=["walk"])]
Sha256 = Annotated[
    str | None, Query(pattern="^[0-9a-f]{64}$", description="SHA-256 of the file, which is checked if given")
]

router = APIRouter(tags=["scenes"])


@router.get("/scenes", summary="The scenes that are served", responses=problems(422))
def list_scenes(service: SharedService) -> SceneList:
    """Names and states, without loading scenes."""
    statuses = service.store.statuses()
    return SceneList(scenes=[SceneEntry(name=each.name, loaded=each.loaded, **_problem(each)) for each in statuses])


@router.get("/scenes/{name}", summary="Description of a scene", responses=problems(404, 422, 503))
def describe_scene(name: SceneName, service: SharedService) -> SceneDetail:
    """Time range, cameras, plan, counts and measured error. Loads the scene if necessary."""
    return _describe(service.store, name)


@router.get("/scenes/{name}/report", summary="Error against run time", responses=problems(404, 422, 503))
def scene_report(name: SceneName, service: SharedService) -> dict[str, Any]:
    """The exporter's measurements of the plans for this scene: the `.report.json` beside its file, in the format
    `msdgs-report/1`. 404 if there is none, or if it is of another file."""
    report = read_report(service.store.file(name), service.store.get(name).session.scene.metadata)
    if report is None:
        raise RequestRejected(HTTPStatus.NOT_FOUND, "not_found", "There is no report for this scene.")
    return report


@router.get(
    "/scenes/{name}/file",
    summary="The scene's file",
    response_class=Response,
    responses={**FILE_RESPONSE, **NOT_MODIFIED, **problems(404, 422, 503)},
)
def scene_file(name: SceneName, service: SharedService, if_none_match: IfNoneMatch = None) -> Response:
    """The bytes that were uploaded or lie in the folder.

    Loads the scene if necessary. A download is finished if the scene is replaced or deleted meanwhile. 503 with
    `Retry-After` until a file that has changed is reloaded, and without it if the new one is broken.
    """
    contents = service.store.open(name)
    if contents is None:
        detail = "The scene's file has changed and is being reloaded."
        raise RequestRejected(HTTPStatus.SERVICE_UNAVAILABLE, "reloading", detail, retry_after=1)
    headers = file_headers(contents)
    if is_unchanged(if_none_match, headers["ETag"]):
        contents.file.close()
        return Response(status_code=HTTPStatus.NOT_MODIFIED, headers=headers)
    return SceneFileResponse(contents, headers, service.reading)


@router.post(
    "/scenes",
    summary="Add a scene",
    status_code=HTTPStatus.CREATED,
    openapi_extra=SCENE_BODY,
    responses=problems(400, 403, 408, 409, 413, 415, 422, 503, 507),
)
async def add_scene(
    name: NewName,
    service: SharedService,
    request: Request,
    response: Response,
    replace: Annotated[bool, Query(description="whether a scene of this name may be replaced")] = False,
    sha256: Sha256 = None,
) -> SceneAdded:
    """Takes a scene file as the body, which is checked and tested in a subprocess before it is added. Renders of a
    scene that it replaces are finished. Requires that the service runs with `--uploads`."""
    service.check_uploads()
    _check_origin(request, service.settings.cors_origins)
    await anyio.to_thread.run_sync(partial(service.store.target, name, replace=replace))
    incoming, uploads = service.store.incoming(uuid.uuid4().hex), service.uploads
    await anyio.to_thread.run_sync(uploads.scan)
    try:
        with uploads.receiving(name, request.scope.get(CLIENT)) as upload:
            digest = await _receive(request, incoming, service, upload)
            if sha256 is not None and not hmac.compare_digest(digest, sha256):
                raise InvalidInput("sha256", "the SHA-256 of the file", "another one")
            add = partial(service.add_scene, name, incoming, replace=replace)
            added = await anyio.to_thread.run_sync(add, limiter=uploads.opening)
            uploads.added(upload)
    except SceneFileInvalid as error:
        service.log_rejected_upload(name, error)
        detail = f"The file violates its contract: `{error.field}` {error.problem}"
        raise RequestRejected(HTTPStatus.UNPROCESSABLE_ENTITY, "invalid_scene", detail, field="body") from None
    finally:
        incoming.unlink(missing_ok=True)
    response.headers["Location"] = f"{request.scope['root_path']}/scenes/{quote(name, safe='')}"
    return SceneAdded(name=added.name, sha256=added.sha256)


@router.delete(
    "/scenes/{name}",
    summary="Delete a scene",
    status_code=HTTPStatus.NO_CONTENT,
    responses=problems(403, 404, 422),
)
async def delete_scene(name: SceneName, service: SharedService) -> None:
    """Deletes the scene's file; renders in progress are finished. Requires that the service runs with `--uploads`."""
    service.check_uploads()
    await anyio.to_thread.run_sync(service.store.remove, name, limiter=service.uploads.opening)
    service.uploads.removed(name)


def _check_origin(request: Request, allowed: Collection[str]) -> None:
    """Raise `RequestRejected` for calls by web pages elsewhere: browsers send a POST without asking the service first.

    A proxy may have another scheme than the service, so that only hosts are compared.
    """
    origin = request.headers.get("origin")
    if origin is None or origin.partition("://")[2] == request.headers.get("host") or {origin, "*"} & set(allowed):
        return
    detail = "A web page of another origin may add scenes only if --cors-origins names it."
    raise RequestRejected(HTTPStatus.FORBIDDEN, "forbidden", detail)


async def _receive(request: Request, target: FilePath, service: Service, upload: Stored) -> str:
    """Write the request body to a file and return its SHA-256."""
    digest = hashlib.sha256()
    async with await anyio.open_file(target, "xb") as file:
        async for part in _parts(request, service.settings.body_seconds):
            service.uploads.grow(upload, len(part))
            digest.update(part)
            await file.write(part)
    return digest.hexdigest()


async def _parts(request: Request, seconds: float) -> AsyncIterator[bytes]:
    """Yield the parts of the request body, each received within `seconds`."""
    stream = aiter(request.stream())
    while True:
        try:
            async with asyncio.timeout(seconds):
                part = await anext(stream)
        except StopAsyncIteration:
            return
        except ClientDisconnect:
            raise ClientGone("the client closed the connection") from None
        except TimeoutError:
            detail = f"The next part of the body must come within {seconds:g} s."
            raise RequestRejected(HTTPStatus.REQUEST_TIMEOUT, "slow_body", detail, field="body") from None
        yield part  # outside of the time limit: what the consumer does takes no time of the client's


def _describe(store: SceneStore, name: str) -> SceneDetail:
    served, status = store.get(name), store.status(name)
    return SceneDetail(
        **described(served.session, served.metadata, served.framing),
        **_problem(status),
        name=name,
        loaded=status.loaded,
        report=has_report(store.file(name), served.session.scene.metadata),
        cost=GraphCost.model_validate(served.session.cost, from_attributes=True),
    )


def _problem(status: SceneStatus) -> dict[str, Any]:
    reason = None if status.problem is None else f"`{status.problem.field}` {status.problem.problem}"
    return {"problem": reason is not None, "reason": reason and reason[:MAX_REASON]}

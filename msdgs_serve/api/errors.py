"""HTTP responses for errors: the table of statuses, and bodies as application/problem+json (RFC 9457)."""

import itertools
import json
import logging
from collections.abc import Mapping, Sequence
from http import HTTPStatus
from typing import Any
from urllib.parse import quote

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import RedirectResponse, Response
from pydantic import BaseModel, Field, ValidationError
from starlette.exceptions import HTTPException

from msdgs_serve.api.methods import methods_at
from msdgs_serve.scene import InvalidInput, MsdgsError, SceneFileInvalid, SceneNotFound
from msdgs_serve.store import SceneExists
from msdgs_serve.video import VideoUnavailable

STATUS_AND_KIND: dict[type[MsdgsError], tuple[HTTPStatus, str]] = {
    InvalidInput: (HTTPStatus.UNPROCESSABLE_ENTITY, "invalid"),
    SceneNotFound: (HTTPStatus.NOT_FOUND, "not_found"),
    SceneExists: (HTTPStatus.CONFLICT, "conflict"),
    VideoUnavailable: (HTTPStatus.NOT_IMPLEMENTED, "unavailable"),
    SceneFileInvalid: (HTTPStatus.SERVICE_UNAVAILABLE, "broken_scene"),
}
KIND = "msdgs.problem"
"""Key of an ASGI scope for the kind of problem in the response, for the metrics."""

CLIENT_CLOSED_REQUEST = 499  # as in nginx

UNIONS = ("camera", "background", "t")
MEMBERS = ("orbit", "look_at", "matrix", "scene", "name", "color", "one", "list")
"""Members of unions: pydantic appends the one that it tried to the field's location."""

NOT_JSON = "must be a JSON object in UTF-8, sent as content-type: application/json"
MESSAGES = {
    "missing": "must be given",
    "extra_forbidden": "isn't a field here; /docs lists those that are",
    "model_type": "must be an object",
    "model_attributes_type": "must be an object",
    "dict_type": "must be an object",
    "list_type": "must be a list",
    "tuple_type": "must be a list",
    "too_short": "must be a list of {min_length} or more, got {actual_length}",
    "too_long": "must be a list of at most {max_length}, got {actual_length}",
}
"""Messages by pydantic's types of errors, where its own are in terms of Python."""

REMOVED = {"min_psnr": "isn't a field any more; `scene` names the file to use, and `GET /scenes/{name}` has its error"}
"""Messages by fields of earlier versions."""

MEDIA_TYPE = "application/problem+json"
MAX_BODY_BYTES = 8192
MAX_ERRORS = 20
MAX_FIELD_LENGTH = 100
MAX_MESSAGE_LENGTH = 200

logger = logging.getLogger("msdgs_serve")


class RequestRejected(MsdgsError):
    """A request is rejected with a status of its own, not for the values of its fields."""

    def __init__(
        self, status: HTTPStatus, kind: str, detail: str, *, field: str | None = None, retry_after: int | None = None
    ) -> None:
        super().__init__(detail)
        self.status = status
        self.kind = kind  # label in the metrics
        self.field = field
        self.headers = {} if retry_after is None else {"Retry-After": str(retry_after)}


class ClientGone(MsdgsError):
    """The client closed the connection before the response was ready."""

    kind = "client_gone"


class FieldError(BaseModel):
    """An invalid value of a request."""

    field: str = Field(description="path in the request, such as `camera.fov_y`", examples=["camera.fov_y"])
    message: str = Field(description="the expected value", examples=["must be in (0, 180) degrees, got 190"])


class Problem(BaseModel):
    """The body of every error (RFC 9457), at most 8 kB."""

    type: str = Field(default="about:blank", description="always `about:blank`; the status tells the kind")
    title: str = Field(description="reason phrase of the status")
    status: int
    detail: str = Field(description="explanation for people")
    errors: list[FieldError] = Field(default=[], description="invalid values of the request")


def problem_response(
    status: int, detail: str, errors: Sequence[FieldError] = (), headers: dict[str, str] | None = None
) -> Response:
    """Return a problem as a response; long texts are truncated."""
    shown = [
        FieldError(
            field=_truncated(error.field, MAX_FIELD_LENGTH), message=_truncated(error.message, MAX_MESSAGE_LENGTH)
        )
        for error in errors[:MAX_ERRORS]
    ]
    problem = Problem(
        title=HTTPStatus(status).phrase, status=status, detail=_truncated(detail, MAX_MESSAGE_LENGTH), errors=shown
    )
    # ASCII: a lone surrogate in a JSON string of the request can't be encoded in UTF-8
    while len(body := json.dumps(problem.model_dump()).encode("ascii")) > MAX_BODY_BYTES:
        problem.errors.pop()
    return Response(body, status, headers, MEDIA_TYPE)


def install_error_handlers(app: FastAPI) -> None:
    """Answer every error of the application with a problem."""
    app.add_exception_handler(MsdgsError, _on_domain_error)
    app.add_exception_handler(RequestValidationError, _on_validation_error)
    app.add_exception_handler(HTTPException, _on_http_error)


def server_error() -> Response:
    """Return the response to an unhandled error."""
    return problem_response(HTTPStatus.INTERNAL_SERVER_ERROR, "Internal error; see the server's log.")


def problem_of(error: Exception) -> tuple[int, bytes]:
    """Return status and body of a problem for one frame of a batch."""
    if isinstance(error, ValidationError):
        response = _invalid([{**item, "loc": ("body", *item["loc"])} for item in error.errors()])
    elif isinstance(error, MsdgsError):
        response = _domain_problem(error)
    else:
        logger.error("a frame of a batch failed", exc_info=error)
        response = server_error()
    return response.status_code, bytes(response.body)


def rejection(error: RequestRejected) -> Response:
    """Return the response to a rejected request."""
    errors = [FieldError(field=error.field, message=str(error))] if error.field else []
    return problem_response(error.status, str(error), errors, error.headers)


async def _on_domain_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, MsdgsError)
    known = isinstance(error, RequestRejected | ClientGone)
    request.scope[KIND] = error.kind if known else STATUS_AND_KIND.get(type(error), (None, "internal"))[1]
    return _domain_problem(error)


def _domain_problem(error: MsdgsError) -> Response:
    if isinstance(error, ClientGone):
        return Response(status_code=CLIENT_CLOSED_REQUEST)  # for metrics and log only
    if isinstance(error, RequestRejected):
        return rejection(error)
    status = next((status for kind, (status, _) in STATUS_AND_KIND.items() if isinstance(error, kind)), None)
    if status is None:
        logger.error("unexpected domain error", exc_info=error)
        return server_error()
    if isinstance(error, SceneFileInvalid):
        logger.error("%s", error)
        return problem_response(status, f"The scene's file is invalid at `{error.field}`; see the server's log.")
    if isinstance(error, VideoUnavailable):
        return problem_response(status, str(error))
    field = error.field if isinstance(error, InvalidInput) else "scene"
    return problem_response(status, str(error), [FieldError(field=field, message=str(error))])


async def _on_validation_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    request.scope[KIND] = "invalid"
    return _invalid(error.errors())


def _invalid(items: Sequence[Any]) -> Response:
    errors = [_field_error(item) for item in items[:MAX_ERRORS]]
    detail = f"`{_truncated(errors[0].field, MAX_FIELD_LENGTH)}`: {errors[0].message}"
    return problem_response(HTTPStatus.UNPROCESSABLE_ENTITY, detail, errors)


async def _on_http_error(request: Request, error: Exception) -> Response:
    """Answer what routing raises, and FastAPI for a body that it can't parse."""
    assert isinstance(error, HTTPException)
    if error.status_code == HTTPStatus.METHOD_NOT_ALLOWED:
        return _not_allowed(request)
    if error.status_code == HTTPStatus.NOT_FOUND and (target := _with_other_slash(request)):
        return RedirectResponse(target)
    if error.status_code == HTTPStatus.BAD_REQUEST:
        return problem_response(
            error.status_code, f"The body {NOT_JSON}.", [FieldError(field="body", message=NOT_JSON)]
        )
    return problem_response(error.status_code, str(error.detail), headers=dict(error.headers or {}))


def _not_allowed(request: Request) -> Response:
    """Answer a method that isn't served at a path: OPTIONS asks for those that are."""
    methods = ", ".join(methods_at(request.scope))
    if request.method == "OPTIONS":
        return Response(status_code=HTTPStatus.NO_CONTENT, headers={"Allow": methods})
    detail = f"`{_truncated(request.method, MAX_FIELD_LENGTH)}` isn't served here, only {methods}."
    return problem_response(HTTPStatus.METHOD_NOT_ALLOWED, detail, headers={"Allow": methods})


def _with_other_slash(request: Request) -> str | None:
    """Return the address with or without a slash at its end, if only that is served.

    It has no host: that of the request may lack a port that the client uses.
    """
    scope, path = request.scope, request.scope["path"]
    other = path.rstrip("/") if path.endswith("/") else f"{path}/"
    if "endpoint" in scope or not methods_at({**scope, "path": other}):
        return None
    prefix, query = scope["root_path"], request.url.query
    return prefix + quote(other.removeprefix(prefix)) + (f"?{query}" if query else "")


def _field_error(item: Mapping[str, Any]) -> FieldError:
    """Return one of pydantic's errors, without its input, which may be large or not representable in JSON."""
    field, message = _field_name(item["loc"]), message_of(item)
    if item["type"] == "json_invalid":
        message = f"isn't JSON from character {item['loc'][-1]} on"
    elif field == "body":
        message = NOT_JSON
    if item["type"] in ("union_tag_invalid", "union_tag_not_found"):
        field, message = f"{field}.type", "must be one of the types listed at /docs"
        if tags := item.get("ctx", {}).get("expected_tags"):
            message = f"must be one of {tags}"
    return FieldError(field=field, message=message)


def message_of(item: Mapping[str, Any]) -> str:
    """Return the text of one of pydantic's errors."""
    if item["type"] == "extra_forbidden" and item["loc"][-1] in REMOVED:
        return REMOVED[item["loc"][-1]]
    return MESSAGES[item["type"]].format(**item.get("ctx", {})) if item["type"] in MESSAGES else item["msg"]


def _field_name(location: Sequence[str | int]) -> str:
    """Return `camera.azimuth` for `("body", "camera", "orbit", "azimuth")`, without members of unions."""
    source, *parts = location
    path = [part for before, part in itertools.pairwise((source, *parts)) if not (before in UNIONS and part in MEMBERS)]
    if not path or (len(path) == 1 and isinstance(path[0], int)):  # no body, or the offset of a JSON error
        return str(source)
    return ".".join(str(part) for part in path)


def _truncated(text: str, length: int) -> str:
    return text if len(text) <= length else text[: length - 1] + "…"

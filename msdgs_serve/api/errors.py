"""Errors as HTTP: one table from domain errors to a status, one body shape (RFC 9457, application/problem+json)."""

import json
import logging
from collections.abc import Sequence
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import Response
from pydantic import BaseModel, Field
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from msdgs_serve.scene import InvalidInput, MsdgsError, SceneFileInvalid, SceneNotFound

STATUS_OF: dict[type[MsdgsError], HTTPStatus] = {
    InvalidInput: HTTPStatus.UNPROCESSABLE_ENTITY,
    SceneNotFound: HTTPStatus.NOT_FOUND,
    SceneFileInvalid: HTTPStatus.SERVICE_UNAVAILABLE,
}

MEDIA_TYPE = "application/problem+json"
MAX_BODY_BYTES = 8192
MAX_ERRORS = 20
MAX_FIELD_LENGTH = 100
MAX_MESSAGE_LENGTH = 200

logger = logging.getLogger("msdgs_serve")


class FieldError(BaseModel):
    """One value that is wrong."""

    field: str = Field(description="where it is in the request, as in `camera.fov_y`", examples=["camera.fov_y"])
    message: str = Field(description="what was expected", examples=["must be in (0, 180) degrees, got 190"])


class Problem(BaseModel):
    """The body of every error (RFC 9457), at most 8 kB."""

    type: str = Field(default="about:blank", description="always `about:blank`: the status says the kind")
    title: str = Field(description="the status in words")
    status: int
    detail: str = Field(description="what went wrong, for people")
    errors: list[FieldError] = Field(default=[], description="the values that are wrong, where the request is to blame")


def problem_response(
    status: int, detail: str, errors: Sequence[FieldError] = (), headers: dict[str, str] | None = None
) -> Response:
    """A problem as a response; what would make it too long is cut off."""
    shown = [
        FieldError(field=_cut(error.field, MAX_FIELD_LENGTH), message=_cut(error.message, MAX_MESSAGE_LENGTH))
        for error in errors[:MAX_ERRORS]
    ]
    problem = Problem(
        title=HTTPStatus(status).phrase, status=status, detail=_cut(detail, MAX_MESSAGE_LENGTH), errors=shown
    )
    # ASCII, because a lone surrogate in a JSON string of the request has no UTF-8
    while len(body := json.dumps(problem.model_dump()).encode("ascii")) > MAX_BODY_BYTES:
        problem.errors.pop()
    return Response(body, status, headers, MEDIA_TYPE)


def install_error_handlers(app: FastAPI) -> None:
    """Make every error of the application a problem."""
    app.add_exception_handler(MsdgsError, _on_domain_error)
    app.add_exception_handler(RequestValidationError, _on_validation_error)
    app.add_exception_handler(HTTPException, _on_http_error)
    app.add_middleware(UnexpectedErrors)


class UnexpectedErrors:
    """ASGI middleware: an error that nothing else handles is logged and answered with 500.

    In place of a handler for `Exception`, after which the connection is closed under a client that may be using it.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        answering = False

        async def watched(message: Message) -> None:
            nonlocal answering
            answering = True
            await send(message)

        try:
            await self._app(scope, receive, watched)
        except Exception as error:
            if answering or scope["type"] != "http":
                raise
            logger.error("%s %s failed", scope["method"], scope["path"], exc_info=error)
            await _server_error()(scope, receive, send)


def _server_error() -> Response:
    return problem_response(HTTPStatus.INTERNAL_SERVER_ERROR, "The server failed; its log says why.")


async def _on_domain_error(_: Request, error: Exception) -> Response:
    status = next((status for kind, status in STATUS_OF.items() if isinstance(error, kind)), None)
    if status is None:
        logger.error("unexpected domain error", exc_info=error)
        return _server_error()
    if isinstance(error, SceneFileInvalid):
        logger.error("%s", error)
        return problem_response(status, f"The scene's file is broken at `{error.field}`; the server's log says how.")
    field = error.field if isinstance(error, InvalidInput) else "scene"
    return problem_response(status, str(error), [FieldError(field=field, message=str(error))])


async def _on_validation_error(_: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    errors = [_field_error(item) for item in error.errors()[:MAX_ERRORS]]
    detail = f"`{_cut(errors[0].field, MAX_FIELD_LENGTH)}`: {errors[0].message}"
    return problem_response(HTTPStatus.UNPROCESSABLE_ENTITY, detail, errors)


async def _on_http_error(_: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    errors = []
    if error.status_code == HTTPStatus.BAD_REQUEST:  # FastAPI's, for a body that is no text or no JSON
        errors.append(FieldError(field="body", message=str(error.detail)))
    return problem_response(error.status_code, str(error.detail), errors, dict(error.headers or {}))


def _field_error(item: dict[str, Any]) -> FieldError:
    """From one of pydantic's errors; its input is left out, it may be huge or have no JSON."""
    field, message = _field_name(item["loc"]), item["msg"]
    if field == "body" and item["type"] != "missing":
        message = f"must be a JSON object, sent as content-type: application/json ({message})"
    if item["type"] in ("union_tag_invalid", "union_tag_not_found"):
        field, message = f"{field}.type", "must be one of those that /docs lists"
        if tags := item.get("ctx", {}).get("expected_tags"):
            message = f"must be one of {tags}"
    return FieldError(field=field, message=message)


def _field_name(location: Sequence[str | int]) -> str:
    """`("body", "camera", "orbit", "azimuth")` → `camera.azimuth`: unions put the chosen member's name third."""
    where, *path = location
    if len(path) > 1 and path[0] in ("camera", "background"):
        del path[1]
    if not path or (len(path) == 1 and isinstance(path[0], int)):  # no body, or the offset of a JSON error
        return str(where)
    return ".".join(str(part) for part in path)


def _cut(text: str, length: int) -> str:
    return text if len(text) <= length else text[: length - 1] + "…"

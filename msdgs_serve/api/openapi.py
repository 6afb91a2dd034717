"""The OpenAPI document: error responses, API keys, and examples for the scenes that are served."""

from collections.abc import Iterable
from http import HTTPStatus
from typing import Any

import numpy as np
from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi

from msdgs_serve.api.errors import MEDIA_TYPE, FieldError, Problem
from msdgs_serve.api.keys import scope_of
from msdgs_serve.api.schemas import BatchItem
from msdgs_serve.imaging import FORMATS
from msdgs_serve.scene.camera import orbit
from msdgs_serve.store import SceneStore, ServedScene
from msdgs_serve.video import VIDEO_FORMATS

Responses = dict[int | str, dict[str, Any]]
Examples = dict[str, dict[str, Any]]


BINARY = {"schema": {"type": "string", "format": "binary"}}


def _file(description: str, media_types: Iterable[str], **headers: str) -> Responses:
    """A file of one of these media types; hyphens in names of headers are given as underscores."""
    response: dict[str, Any] = {"description": description, "content": dict.fromkeys(media_types, BINARY)}
    if headers:
        texts = {name.replace("_", "-"): text for name, text in headers.items()}
        response["headers"] = {n: {"description": text, "schema": {"type": "string"}} for n, text in texts.items()}
    return {200: response}


IMAGE_RESPONSE = _file(
    "The frame",
    [traits.media_type for traits in FORMATS.values()],
    ETag="ETag of scene file and request",
    Server_Timing="milliseconds by stage: queue, pose (cached or not), draw, encode",
    Msdgs_Scene="the scene's name, percent-encoded",
    Msdgs_Plan="how the scene's motion is computed",
    Msdgs_Error="PSNR in dB of the file's worst frame against the full model, if measured",
    Msdgs_Channels="channels of the file, in order",
)
NOT_MODIFIED: Responses = {304: {"description": "The client has this version"}}
FILE_RESPONSE = _file(
    "The file",
    ["application/octet-stream"],
    ETag="SHA-256 of the file",
    Content_Disposition="with the file's name",
)
BATCH_RESPONSE: Responses = {
    200: {
        "description": "A frame or a problem per line or part",
        "content": {
            "application/x-ndjson": {"schema": {"$ref": "#/components/schemas/BatchItem"}},
            "multipart/mixed": BINARY,
        },
    }
}
VIDEO_RESPONSE = _file("The video", [traits.media_type for traits in VIDEO_FORMATS.values()])
SCENE_BODY = {
    "requestBody": {
        "required": True,
        "description": "a scene file, contract `msdgs/1` or `msdgs/2`",
        "content": {"application/octet-stream": BINARY},
    }
}


def problems(*statuses: int) -> Responses:
    """Return the error responses of a call."""
    content = {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}}
    return {status: {"description": HTTPStatus(status).phrase, "content": content} for status in statuses}


def install_openapi(app: FastAPI, store: SceneStore, *, keys: bool) -> None:
    """Replace the application's OpenAPI document by one with examples for the scene that is loaded."""

    def build() -> dict[str, Any]:
        if app.openapi_schema is None:
            document = get_openapi(title=app.title, version=app.version, description=app.description, routes=app.routes)
            for model in (Problem, FieldError, BatchItem):
                schema = model.model_json_schema(ref_template="#/components/schemas/{model}")
                schema.pop("$defs", None)
                document["components"]["schemas"][model.__name__] = schema
            if keys:
                _add_keys(document)
            app.openapi_schema = document
        body = app.openapi_schema["paths"]["/render"]["post"]["requestBody"]["content"]["application/json"]
        body["examples"] = render_examples(store)
        return app.openapi_schema

    app.openapi = build


def render_examples(store: SceneStore) -> Examples:
    """Return example bodies of `POST /render` for the first loaded scene; none if no scene is loaded."""
    statuses = store.statuses()
    loaded = next((status.name for status in statuses if status.loaded), None)
    if loaded is None:
        return {}
    return _examples(store.get(loaded), {"scene": loaded} if len(statuses) > 1 else {})


def _add_keys(document: dict[str, Any]) -> None:
    """Add the scope that each call needs."""
    schemes = {
        "bearer": {"type": "http", "scheme": "bearer"},
        "key": {"type": "apiKey", "in": "header", "name": "X-API-Key"},
    }
    document["components"]["securitySchemes"] = schemes
    refusals = problems(401, 403)
    for path, calls in document["paths"].items():
        for method, call in calls.items():
            if (scope := scope_of(method.upper(), path)) is not None:
                call["security"] = [{name: [scope]} for name in schemes]
                call["responses"] |= {str(status): response for status, response in refusals.items()}


def _examples(served: ServedScene, scene: dict[str, str]) -> Examples:
    frame, metadata = served.framing, served.metadata
    pose = orbit(frame.target, frame.distance, azimuth=60, elevation=25, up=frame.up)
    t = float(np.clip(round(np.mean(metadata.time_range), 4), *metadata.time_range))
    size = {"width": 400, "height": 400}
    around = {"type": "orbit", "azimuth": 30, "elevation": 20}
    look_at = {"type": "look_at", "eye": _rounded(pose[:3, 3]), "target": _rounded(frame.target), "fov_y": 45}
    matrix = {"type": "matrix", "camera_to_world": _rounded(pose), "fx": 500.0, "cx": 200.0, "cy": 200.0}
    bodies = {
        "Around the scene": {"camera": around, "t": t, **size},
        "From an eye to a target": {"camera": look_at, "t": t, **size},
        "By matrix and intrinsics": {"camera": matrix, "t": t, **size},
        "Without background, WebP": {
            "camera": around, "t": t, **size, "format": "webp", "quality": 80, "background": "transparent"
        },
        "Linear color, alpha and depth, EXR": {"camera": around, "t": t, **size, "format": "exr"},
        "Depth as an image": {"camera": around, "t": t, **size, "channels": ["depth"]},
        "Color and depth as a NumPy array": {
            "camera": around, "t": t, **size, "format": "npy", "channels": ["rgb", "depth"]
        },
    }  # fmt: skip
    if metadata.cameras:
        bodies["A camera of the scene"] = {"camera": {"type": "scene", "index": 0}, "t": t, "width": 400}
    return {name: {"summary": name, "value": {**scene, **body}} for name, body in bodies.items()}


def _rounded(array: np.ndarray) -> list[Any]:
    return np.round(array, 6).tolist()

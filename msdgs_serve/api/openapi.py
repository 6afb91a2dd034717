"""The OpenAPI document: error bodies on every call, and examples that work on the scenes being served."""

from http import HTTPStatus
from typing import Any

import numpy as np
from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi

from msdgs_serve.api.cameras import framing
from msdgs_serve.api.errors import MEDIA_TYPE, FieldError, Problem
from msdgs_serve.imaging import FORMATS
from msdgs_serve.scene import SceneFileInvalid
from msdgs_serve.scene.baked import SceneMetadata
from msdgs_serve.scene.camera import orbit
from msdgs_serve.store import SceneStore

Responses = dict[int | str, dict[str, Any]]
Examples = dict[str, dict[str, Any]]

IMAGE_RESPONSE: Responses = {
    200: {
        "description": "The frame",
        "content": {
            traits.media_type: {"schema": {"type": "string", "format": "binary"}} for traits in FORMATS.values()
        },
    }
}


def problems(*statuses: HTTPStatus) -> Responses:
    """The part of a call's `responses` on its errors."""
    content = {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}}
    return {status.value: {"description": status.phrase, "content": content} for status in statuses}


def install_openapi(app: FastAPI, examples: Examples) -> None:
    """Replace the application's OpenAPI document by one that holds `examples` for `POST /render`."""

    def build() -> dict[str, Any]:
        if app.openapi_schema is None:
            document = get_openapi(title=app.title, version=app.version, description=app.description, routes=app.routes)
            for model in (Problem, FieldError):
                schema = model.model_json_schema(ref_template="#/components/schemas/{model}")
                schema.pop("$defs", None)
                document["components"]["schemas"][model.__name__] = schema
            document["paths"]["/render"]["post"]["requestBody"]["content"]["application/json"]["examples"] = examples
            app.openapi_schema = document
        return app.openapi_schema

    app.openapi = build


def render_examples(store: SceneStore) -> Examples:
    """Bodies for `POST /render` that work on the first scene that can be loaded."""
    names = store.names()
    for name in names:
        try:
            metadata = store.get(name).scene.metadata
        except SceneFileInvalid:
            continue
        return _examples(metadata, {"scene": name} if len(names) > 1 else {})
    return {}


def _examples(metadata: SceneMetadata, scene: dict[str, str]) -> Examples:
    frame = framing(metadata)
    pose = orbit(frame.target, frame.distance, azimuth=60, elevation=25, up=frame.up)
    t = float(np.clip(round(np.mean(metadata.time_range), 4), *metadata.time_range))
    size = {"width": 400, "height": 400}
    around = {"type": "orbit", "azimuth": 30, "elevation": 20}
    look_at = {"type": "look_at", "eye": _rounded(pose[:3, 3]), "target": _rounded(frame.target), "fov_y": 45}
    matrix = {"type": "matrix", "camera_to_world": _rounded(pose), "fx": 500.0, "cx": 200.0, "cy": 200.0}
    bodies = {
        "Around the scene": {"camera": around, "t": t, **size},
        "From a place to a place": {"camera": look_at, "t": t, **size},
        "By matrix and intrinsics": {"camera": matrix, "t": t, **size},
        "Without background, WebP": {
            "camera": around, "t": t, **size, "format": "webp", "quality": 80, "background": "transparent"
        },
        "Linear colour, alpha and depth, EXR": {"camera": around, "t": t, **size, "format": "exr"},
    }  # fmt: skip
    if metadata.cameras:
        bodies["A camera of the scene"] = {"camera": {"type": "scene", "index": 0}, "t": t, "width": 400}
    return {name: {"summary": name, "value": {**scene, **body}} for name, body in bodies.items()}


def _rounded(array: np.ndarray) -> list[Any]:
    return np.round(array, 6).tolist()

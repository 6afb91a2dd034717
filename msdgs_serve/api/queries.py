"""Convert the query of `GET /render` to the request of `POST /render`."""

from typing import Any

from pydantic import ValidationError
from starlette.datastructures import QueryParams

from msdgs_serve.api.errors import message_of
from msdgs_serve.api.schemas import RenderQuery, RenderRequest
from msdgs_serve.scene import InvalidInput
from msdgs_serve.scene.baked import SceneMetadata

DEFAULT_VIEW = {"azimuth": 30.0, "elevation": 20.0}
ORBIT_FIELDS = ("azimuth", "elevation", "distance")
LOOK_AT_FIELDS = ("target", "up", "fov_y")
PASSED_ON = ("scene", "steps", "dt", "width", "height", "format", "quality")


def request_of(query: RenderQuery, metadata: SceneMetadata) -> RenderRequest:
    """Return the request of a query. Raises `InvalidInput` naming the parameter."""
    given = query.model_dump(exclude_none=True)
    body = {name: given[name] for name in PASSED_ON if name in given}
    body |= {"camera": _camera(given), "t": given.get("t", metadata.time_range[0])}
    if "channels" in given:
        body["channels"] = given["channels"].split(",")
    if "region" in given:
        body["region"] = _numbers("region", given["region"], int)
    if "depth_range" in given:
        body["depth_range"] = _numbers("depth_range", given["depth_range"])
    if "background" in given:
        text = given["background"]
        body["background"] = _numbers("background", text) if "," in text else text
    try:
        return RenderRequest.model_validate(body)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        raise InvalidInput(
            _parameter(first["loc"]), f"as in POST /render ({message_of(first)})", "another value"
        ) from None


def refuse_repeated(parameters: QueryParams) -> None:
    """Raise `InvalidInput` for a parameter that is given twice."""
    for name in parameters:
        if len(values := parameters.getlist(name)) > 1:
            raise InvalidInput(name, "given once; lists are joined by commas", f"{len(values)} times")


def by_parameter(error: InvalidInput) -> InvalidInput:
    """Return an error of the request with the parameters in place of its fields, also in the text."""
    field, expected = (
        text.replace("camera.name", "camera").replace("camera.", "") for text in (error.field, error.expected)
    )
    return InvalidInput(field, expected, error.got)


def _camera(given: dict[str, Any]) -> dict[str, Any]:
    by_name, orbit = [name for name in ("camera", "index") if name in given], [n for n in ORBIT_FIELDS if n in given]
    if by_name:
        camera = {"type": "scene", **{{"camera": "name"}.get(name, name): given[name] for name in by_name}}
        unused = [*orbit, *(name for name in ("eye", *LOOK_AT_FIELDS) if name in given)]
        kind = by_name[0]
    elif "eye" in given:
        camera = {"type": "look_at", "eye": _numbers("eye", given["eye"])}
        unused, kind = orbit, "eye"
    else:
        camera = {"type": "orbit", **DEFAULT_VIEW, **{name: given[name] for name in orbit}}
        unused, kind = [], ""
    if unused:
        raise InvalidInput(unused[0], f"left out if {kind} is given", given[unused[0]])
    if not by_name:
        for name in LOOK_AT_FIELDS:
            if name in given:
                camera[name] = given[name] if name == "fov_y" else _numbers(name, given[name])
    return camera


def _numbers(name: str, text: str, kind: type[float] | type[int] = float) -> list[float]:
    try:
        return [kind(part) for part in text.split(",")]
    except ValueError:
        expected = "comma-separated numbers" if kind is float else "comma-separated whole numbers"
        raise InvalidInput(name, expected, repr(text[:20])) from None


def _parameter(location: tuple[str | int, ...]) -> str:
    texts = [part for part in location if isinstance(part, str)]
    return texts[2] if texts[0] == "camera" and len(texts) > 2 else str(texts[0])

"""Invalid requests get a short 4xx that names the field and doesn't repeat the input."""

import itertools
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from tests.support.service import FRAME, ORBIT, check_problem, in_this_process, serving

LOOK_AT = {"type": "look_at", "eye": [5, 0, 0], "target": [0, 0, 0], "up": [0, 0, 1]}
POSE = [[0, 0, -1, 5], [1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]]
MATRIX = {"type": "matrix", "camera_to_world": POSE, "fx": 50}
SCENE = {"type": "scene"}

NAN, INFINITY, HUGE = json.loads("NaN"), json.loads("Infinity"), 10**400
NOT_NUMBERS = [NAN, INFINITY, -INFINITY, HUGE, -HUGE, 1e300, "1", "", True, [], [1], {}, {"a": 1}]
NOT_FINITE = [NAN, INFINITY, -INFINITY, HUGE, 1e300]


@pytest.fixture(scope="module")
def client(scene: Path) -> Iterator[httpx.Client]:
    with serving(scene, max_pixels=10_000, max_body_bytes=200_000, max_samples=16, max_batch=8) as client:
        yield client


def refused(client: httpx.Client, body: Any, status: int = 422, path: str = "/render") -> list[str]:
    """Return the fields that the response to an invalid body names."""
    content = body if isinstance(body, bytes) else json.dumps(body).encode()
    response = client.post(path, content=content, headers={"content-type": "application/json"})
    check_problem(response, status)
    return [error["field"] for error in response.json()["errors"]]


def changed(field: str, value: Any) -> dict[str, Any]:
    """Return a valid body with one field changed; a camera's field is changed in a camera of the type that has it."""
    cameras = {"eye": LOOK_AT, "target": LOOK_AT, "up": LOOK_AT, "camera_to_world": MATRIX}
    cameras |= dict.fromkeys(("fx", "fy", "cx", "cy", "axes"), MATRIX)
    cameras |= dict.fromkeys(("index", "name"), SCENE)
    name, _, inner = field.partition(".")
    if not inner:
        return {**FRAME, name: value}
    return {**FRAME, "camera": {**cameras.get(inner, ORBIT), inner: value}}


def test_the_bodies_are_valid_before_they_are_changed(client: httpx.Client):
    for camera in (ORBIT, LOOK_AT, MATRIX, SCENE):
        assert client.post("/render", json={**FRAME, "camera": camera}).status_code == 200


NUMBERS = "t", *(f"camera.{name}" for name in ("azimuth", "elevation", "distance", "fov_y", "fx", "fy", "cx", "cy"))


INTEGERS = ("width", "height", "quality", "camera.index")
TRIPLES = ("camera.eye", "camera.target", "camera.up", "background")
NOT_INTEGERS = [*NOT_NUMBERS, 1.5, -1, 10**9]
NOT_TRIPLES = ["x", 1, True, [], [1, 1], [1, 1, 1, 1], [1, None, 1], [[1, 1, 1]], {}, {"0": 1}]
NOT_TRIPLES += [[1, 1, bad] for bad in NOT_NUMBERS]
OTHERS = {
    "t": [None, -0.001, 1.001],
    "width": [0, 16385],
    "height": [0, 16384],
    "scene": ["", 7, "x" * 201, "\ud800"],
    "format": ["gif", None, ["png"]],
    "quality": [0, 101],
    "background": ["blue", [2, 0, 0], [-0.1, 0, 0]],
    "camera": [None, [], "orbit", {}, {"type": "fisheye"}, {"type": "\ud800"}, {"type": ["orbit"]}],
    "camera.elevation": [90, -90],
    "camera.distance": [0, -1],
    "camera.fov_y": [0, 180, 1e-300],
    "camera.up": [[0, 0, 0], [1e-200, 0, 0], [1, 0, 0]],
    "camera.target": [[5, 0, 0]],
    "camera.fx": [0, -50, 1e-300],
    "camera.fy": [0],
    "camera.axes": ["maya"],
    "camera.camera_to_world": [
        POSE[:3],
        [row[:3] for row in POSE],
        np.zeros((4, 4)).tolist(),
        (2 * np.array(POSE)).tolist(),
        np.diag([1, 1, -1, 1]).tolist(),
        [[1, 2, 3, 0], [2, 4, 6, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
        [*POSE[:3], [0, 0, 1, 1]],
    ],
    "camera.index": [2],
    "camera.name": ["view_1"],
    "camera.surprise": [1],
    "surprise": [1],
}
INVALID = dict.fromkeys(NUMBERS, NOT_NUMBERS)
INVALID |= dict.fromkeys(INTEGERS, NOT_INTEGERS) | dict.fromkeys(TRIPLES, NOT_TRIPLES)


@pytest.mark.parametrize("field", INVALID | OTHERS)
def test_an_invalid_value_is_refused_by_the_name_of_its_field(client: httpx.Client, field: str):
    beside = {"format": "jpeg"} if field == "quality" else {}
    for value in [*INVALID.get(field, []), *OTHERS.get(field, [])]:
        fields = refused(client, {**beside, **changed(field, value)})
        assert all(name.startswith(field) for name in fields), value


@pytest.mark.parametrize("bad", NOT_FINITE, ids=lambda value: repr(value)[:12])
def test_every_number_of_a_matrix_is_checked(client: httpx.Client, bad: Any):
    for row, column in itertools.product(range(4), range(4)):
        pose = [list(numbers) for numbers in POSE]
        pose[row][column] = bad
        assert refused(client, changed("camera.camera_to_world", pose)) == [f"camera.camera_to_world.{row}.{column}"]


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"camera": {**MATRIX, "fov_y": 40}}, "camera.fov_y"),
        ({"camera": {"type": "matrix", "camera_to_world": POSE}}, "camera.fov_y"),
        ({"camera": {"type": "matrix", "camera_to_world": POSE, "fov_y": 40, "fy": 50}}, "camera.fy"),
        ({"camera": {**MATRIX, "distortion": [0.1, 0, 0, 0]}}, "camera.distortion"),
        ({"camera": {**MATRIX, "model": "fisheye", "fx": None, "fov_y": 40}}, "camera.fov_y"),
        ({"camera": {**MATRIX, "model": "panorama"}}, "camera.model"),
        ({"camera": MATRIX, "width": None}, "width"),
        ({"camera": MATRIX, "height": None}, "height"),
        ({"camera": {"type": "scene", "name": "view_0", "index": 0}}, "camera.index"),
        ({"camera": {"type": "scene", "index": 0}, "height": 16384, "width": None}, "width"),
        ({"format": "jpeg", "background": "transparent"}, "background"),
        ({"format": "jpeg", "background": None}, "background"),
        ({"format": "png", "quality": 90}, "quality"),
        ({"format": "webp", "width": 16384, "height": 1}, "width"),
        ({"width": 101, "height": 100}, "width"),
        ({"t": [], "format": "npy"}, "t"),
        ({"t": [0.5] * 9, "format": "npy"}, "t"),
        ({"t": [0.5, 2.0], "format": "npy"}, "t"),
        ({"t": [0.5, NAN], "format": "npy"}, "t.1"),
        ({"t": [0.0] * 5, "format": "npy", "width": 100, "height": 30}, "t"),
        ({"shutter": {"open": 0, "close": 0}}, "shutter.close"),
        ({"shutter": {"open": -0.6, "close": 0}}, "shutter.open"),
        ({"shutter": {"open": 0, "close": 0.6}}, "shutter.close"),
        ({"shutter": {"open": 0, "close": 0.1, "samples": 17}}, "shutter.samples"),
        ({"shutter": {"open": 0, "close": 0.1, "samples": 0}}, "shutter.samples"),
        ({"channels": []}, "channels"),
        ({"channels": ["rgb", "depth"]}, "channels"),
        ({"channels": ["rgb", "rgb"], "format": "npy"}, "channels"),
        ({"channels": ["smell"]}, "channels.0"),
        ({"channels": ["motion"]}, "dt"),
        ({"channels": ["motion"], "dt": 0.95}, "dt"),
        ({"channels": ["rgb"], "dt": 0.2}, "dt"),
        ({"channels": ["motion"], "dt": 0.2, "shutter": {"open": 0, "close": 0.1}}, "shutter"),
        ({"depth_range": [1, 1]}, "depth_range"),
        ({"depth_range": [0, INFINITY]}, "depth_range.1"),
    ],
    ids=lambda value: repr(value)[:40],
)
def test_values_that_do_not_go_together(client: httpx.Client, change: dict[str, Any], field: str):
    assert refused(client, {**FRAME, **change})[0] == field


@pytest.mark.parametrize("field", ["camera", "t", "camera.type", "camera.azimuth", "camera.elevation"])
def test_missing_fields(client: httpx.Client, field: str):
    body = {**FRAME, "camera": dict(ORBIT)}
    *parents, name = field.split(".")
    del (body["camera"] if parents else body)[name]
    assert refused(client, body) == [field]


@pytest.mark.parametrize(
    ("body", "status"),
    [
        (b"", 422),
        (b"null", 422),
        (b"[]", 422),
        (b"7", 422),
        (b'"text"', 422),
        (b"{", 422),
        (b"\xff", 400),
        (b"[" * 100_000, 400),
        (b'{"t":' * 30_000, 400),
        (b'{"t":' + b"1" * 10_000 + b"}", 400),
        (b"x" * 200_001, 413),
        (b'{"scene": "' + b"x" * 10_000_000 + b'"}', 413),
    ],
    ids=lambda value: repr(value)[:20],
)
@pytest.mark.parametrize("path", ["/render", "/render/batch", "/render/video"])
def test_bodies_that_are_no_object(client: httpx.Client, path: str, body: bytes, status: int):
    assert refused(client, body, status, path) == ["body"]


def test_a_long_body_without_an_announced_length(client: httpx.Client):
    response = client.post("/render", content=(b"x" * 10_000 for _ in range(100)))
    check_problem(response, 413)


@pytest.mark.parametrize("text", ["x", "é", "\U0001f600", "\ud800", '"', "\0"], ids=ascii)
@pytest.mark.parametrize("field", ["scene", "format", "surprise", "camera.type", "camera.name"])
def test_long_text_is_not_sent_back(client: httpx.Client, field: str, text: str):
    count = 190_000 // len(json.dumps(text))
    fields = refused(client, changed(field, text * count))
    assert len(fields) == 1


def test_a_thousand_long_keys_give_a_short_answer(client: httpx.Client):
    fields = refused(client, {**FRAME, **{f"{number}\U0001f600" * 20: 1 for number in range(400)}})
    assert 1 <= len(fields) < 400


def test_a_form_is_refused_as_not_json(client: httpx.Client):
    response = client.post("/render", data={"t": "1"})
    check_problem(response, 422)
    assert "application/json" in response.json()["detail"]


@pytest.mark.parametrize(
    ("method", "path", "status"),
    [
        ("GET", "/nothing", 404),
        ("PUT", "/render", 405),
        ("DELETE", "/scenes/balls", 403),
        ("GET", "/scenes/nothing", 404),
        ("GET", "/scenes/..%2Fballs", 404),
        ("GET", "/scenes/%00", 404),
        ("GET", "/scenes/" + "x" * 201, 422),
    ],
)
def test_other_calls_fail_in_the_same_shape(client: httpx.Client, method: str, path: str, status: int):
    check_problem(client.request(method, path), status)


@pytest.mark.parametrize(
    "camera",
    [
        {**LOOK_AT, "eye": [1e9, 0, 0]},
        {**LOOK_AT, "eye": [1e-6, 0, 0]},
        {**LOOK_AT, "eye": [0, 0, 1], "target": [0, 0, 5], "up": [1e-6, 0, 0]},
        {**ORBIT, "distance": 1e-6},
        {**ORBIT, "distance": 1e9, "azimuth": 1e9},
        {**ORBIT, "fov_y": 0.01},
        {**ORBIT, "fov_y": 179},
        {**MATRIX, "fx": 1e-3, "fy": 1e8},
        {**MATRIX, "cx": 1e9, "cy": -1e9},
        {**MATRIX, "fx": 1e8, "cx": -1e9},
    ],
    ids=lambda value: repr(value)[-40:],
)
def test_extreme_but_valid_cameras_are_drawn(client: httpx.Client, camera: dict[str, Any]):
    response = client.post("/render", json={**FRAME, "camera": camera})
    assert response.status_code == 200, response.text


@pytest.mark.parametrize("frames", [[], [FRAME] * 9, "x", [1], None], ids=["none", "many", "text", "number", "null"])
def test_invalid_batches(client: httpx.Client, frames: Any):
    assert refused(client, {"frames": frames}, path="/render/batch")[0].startswith("frames")


@in_this_process
def test_a_failure_of_the_server_reveals_nothing_of_its_inside(
    client: httpx.Client, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    def fail(*_: object) -> bytes:
        raise RuntimeError("secret")

    monkeypatch.setattr("msdgs_serve.api.frames.encode", fail)
    response = client.post("/render", json=FRAME)
    check_problem(response, 500)
    batch = client.post("/render/batch", json={"frames": [FRAME]})
    assert json.loads(batch.content)["status"] == 500
    assert "secret" not in response.text + batch.text
    assert client.get("/live").status_code == 200, "the connection is still usable"
    assert any(record.exc_info and "secret" in str(record.exc_info[1]) for record in caplog.records)

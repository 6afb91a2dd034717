"""Bodies that no call takes: the answer says what is expected, in words of this API."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av
import httpx
import pytest

from msdgs_serve.api.errors import NOT_JSON
from tests.support.service import FRAME, ORBIT, check_problem, in_this_process, serving

OF_LIBRARIES = re.compile("(?i)decod|codec|expecting|dictionar|numpy|pars|pydantic|validation|extra input|'utf-8'")
LIST = "must be a list of 1 or more, got 0"
EMPTY_PATH = (
    "`path.camera_path` must be a list of one camera or more, which nerfstudio's viewer writes if its path has two "
    "keyframes or more, got an empty list"
)


MALFORMED = re.compile(r"isn't JSON from character \d+ on")


@pytest.fixture(scope="module")
def client(scene: Path) -> Iterator[httpx.Client]:
    with serving(scene) as client:
        yield client


@pytest.mark.parametrize("path", ["/render", "/render/batch", "/render/video"])
@pytest.mark.parametrize(
    "content",
    [b"", b"nope", b"{", b'{"t": }', b"{'t': 1}", b'{"t": 1,}', b"[]", b"[{}]", b"null", b'"x"', b"5", b"true", b"NaN",
     b"\xff\xfe", b"\x80{}", b"[" * 5000, b'{"a":' * 5000, b"\x89PNG\r\n", b'{"t":"\n"}'],
    ids=lambda content: repr(content[:12]),
)  # fmt: skip
def test_a_body_that_is_no_json_object(client: httpx.Client, path: str, content: bytes):
    for kind in ("application/json", "text/plain", "application/x-www-form-urlencoded", "image/png"):
        response = client.post(path, content=content, headers={"Content-Type": kind})
        assert response.status_code in (400, 422)
        ((field, message),) = (each.values() for each in response.json()["errors"])
        assert field == "body"
        assert message == NOT_JSON or (kind == "application/json" and MALFORMED.fullmatch(message)), message
        assert not OF_LIBRARIES.search(response.text), response.text


@pytest.mark.parametrize(
    ("path", "body", "field", "message"),
    [
        ("/render/video", {"path": {"camera_path": []}}, "path.camera_path", EMPTY_PATH),
        ("/render/video", {"camera_path": []}, "camera_path", "isn't a field here; /docs lists those that are"),
        ("/render/video", {"path": {}}, "path.camera_path", "must be given"),
        ("/render/video", {"path": []}, "path", "must be an object"),
        ("/render/video", {"path": {"camera_path": {}}}, "path.camera_path", "must be a list"),
        ("/render/video", {"path": {"camera_path": [1]}}, "path.camera_path.0", "must be an object"),
        ("/render/video", {"path": {"camera_path": None}}, "path.camera_path", "must be a list"),
        ("/render/video", {"frames": []}, "frames", LIST),
        ("/render/video", {}, "frames", "`frames` must be given, or path, got neither"),
        ("/render/batch", {"frames": []}, "frames", LIST),
        ("/render/batch", {"frames": [1]}, "frames.0", "must be an object"),
        ("/render/batch", {}, "frames", "must be given"),
        ("/render", {**FRAME, "t": []}, "t", LIST),
        ("/render", {**FRAME, "channels": []}, "channels", LIST),
        ("/render", {**FRAME, "camera": []}, "camera", "must be an object"),
        ("/render", {**FRAME, "camera": "orbit"}, "camera", "must be an object"),
        ("/render", {**FRAME, "camera": {**ORBIT, "up": [0, 1]}}, "camera.up.2", "must be given"),
        ("/render", {**FRAME, "shutter": 1}, "shutter", "must be an object"),
        ("/render", {"t": 0}, "camera", "must be given"),
    ],
)
def test_a_wrong_shape_is_named(client: httpx.Client, path: str, body: Any, field: str, message: str):
    response = client.post(path, json=body)
    check_problem(response, 422, field)
    assert response.json()["errors"][0]["message"] == message
    assert not OF_LIBRARIES.search(response.text), response.text


def test_a_short_vector_in_a_link_is_named(client: httpx.Client):
    response = client.get("/render?eye=1,2")
    check_problem(response, 422, "eye")
    assert "must be given" in response.json()["detail"]


@in_this_process
def test_a_missing_encoder_is_named(client: httpx.Client, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(av, "codecs_available", av.codecs_available - {"libx264"})
    body = {"frames": [{"camera": ORBIT, "t": 0.0}], "width": 8, "height": 8}
    response = client.post("/render/video", json={**body, "format": "mp4"})
    check_problem(response, 501)
    assert response.json()["detail"].startswith("mp4 needs libx264, which this build of PyAV lacks")
    assert client.post("/render/video", json={**body, "format": "webp"}).status_code == 200


@pytest.mark.parametrize(
    "coding", ["gzip", "deflate", "br", "zstd", "gzip, br", "identity, gzip", "x-gzip", "what", "GZIP"]
)
def test_a_compressed_body_is_refused(client: httpx.Client, coding: str):
    for path in ("/render", "/render/batch", "/render/video", "/scenes?name=new"):
        response = client.post(path, content=b"\x1f\x8b\x08", headers={"Content-Encoding": coding})
        check_problem(response, 415, "body")
        assert coding.rpartition("identity, ")[2] in response.json()["detail"]
        assert response.headers["Accept-Encoding"] == "identity"
    assert client.post("/render", content=iter([b"\x1f"] * 3), headers={"Content-Encoding": coding}).status_code == 415


@pytest.mark.parametrize("coding", ["identity", "Identity", "", "identity, identity"])
def test_a_body_as_it_is_needs_no_coding(client: httpx.Client, coding: str):
    body = {"camera": {"type": "orbit", "azimuth": 0, "elevation": 0}, "t": 0.0, "width": 8, "height": 8}
    assert client.post("/render", json=body, headers={"Content-Encoding": coding}).status_code == 200

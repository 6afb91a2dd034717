"""Uploads and deletions of scenes: each is complete or has no effect, and only valid scenes are stored."""

import asyncio
import hashlib
import logging
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import httpx
import numpy as np
import pytest
from starlette.requests import Request

from msdgs_serve.api.routes import scenes
from msdgs_serve.store import SceneStore
from tests.support.images import decode
from tests.support.scene_files import write_scene
from tests.support.service import FRAME, check_problem, connect, eventually, in_this_process, own_connection, serving


@pytest.fixture
def client(folder: Path) -> Iterator[httpx.Client]:
    with serving(folder, uploads=True, max_scene_megabytes=1) as client:
        yield client


def add(client: httpx.Client, content: Any, name: str = "walk", **query: Any) -> httpx.Response:
    return client.post("/scenes", content=content, params={"name": name, **query})


def files(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.parent.rglob("*") if path.is_file() and path.parent == folder)


def test_a_scene_is_added_shown_and_deleted(client: httpx.Client, folder: Path, file: bytes):
    response = add(client, file, sha256=hashlib.sha256(file).hexdigest())
    assert response.status_code == 201, response.text
    assert response.json() == {"name": "walk", "sha256": hashlib.sha256(file).hexdigest()}
    assert (
        client.get(response.request.url.join(response.headers["Location"])).json()["sha256"]
        == response.json()["sha256"]
    )
    assert client.post("/render", json=FRAME).status_code == 200
    assert client.delete("/scenes/walk").status_code == 204
    assert client.post("/render", json={**FRAME, "scene": "walk"}).status_code == 404
    assert files(folder) == []


def test_a_scene_is_replaced_only_on_request(client: httpx.Client, tmp_path: Path, file: bytes):
    assert add(client, file).status_code == 201
    blue = write_scene(tmp_path / "blue.onnx", static_color=(0, 0, 1)).read_bytes()
    check_problem(add(client, blue), 409)
    assert client.get("/scenes/walk").json()["sha256"] == hashlib.sha256(file).hexdigest()
    assert add(client, blue, replace="true").status_code == 201
    pixels, _ = decode(client.post("/render", json={**FRAME, "t": 0, "width": 64, "height": 64}).content, "png")
    assert pixels[32, 32].argmax() == 2


@pytest.mark.parametrize(
    "name", [".", "../walk", "a/b", "/etc/walk", "a\\b", ".hidden", "..", "a\0b", "a\nb", "x" * 201, "ö" * 101, ""]
)
def test_names_with_separators_and_the_like_are_refused(client: httpx.Client, folder: Path, file: bytes, name: str):
    check_problem(add(client, file, name), 422, "name")
    assert files(folder) == []
    assert not (folder.parent / "scenes.onnx").exists()


@pytest.mark.parametrize("content", [b"", b"no scene", b"\x08\x0a"], ids=["empty", "text", "beginning"])
def test_invalid_files_are_refused_and_change_nothing(client: httpx.Client, folder: Path, file: bytes, content: bytes):
    check_problem(add(client, content), 422)
    assert files(folder) == []
    assert add(client, file).status_code == 201
    check_problem(add(client, content, replace="true"), 422)
    assert files(folder) == ["walk.onnx"]
    assert client.get("/scenes").json()["scenes"][0]["problem"] is False
    assert client.post("/render", json=FRAME).status_code == 200


@in_this_process
def test_an_invalid_file_is_no_error_of_the_service(client: httpx.Client, caplog: pytest.LogCaptureFixture):
    """One line of the log with the scene's name, not the temporary file's."""
    caplog.set_level(logging.INFO, "msdgs_serve")
    assert add(client, b"no scene", "a walk").status_code == 422
    ((level, text),) = [(each.levelno, each.getMessage()) for each in caplog.records if each.name == "msdgs_serve"]
    assert level == logging.INFO
    assert "'a walk'" in text
    assert ".incoming" not in text


def test_a_file_that_was_damaged_on_its_way_is_refused(client: httpx.Client, folder: Path, file: bytes):
    damaged = bytearray(file)
    place = file.index(np.float32(0.15).tobytes())
    damaged[place] ^= 1
    check_problem(add(client, bytes(damaged), sha256=hashlib.sha256(file).hexdigest()), 422, "sha256")
    assert files(folder) == []


def test_a_file_that_is_too_large_is_refused(client: httpx.Client, folder: Path):
    check_problem(add(client, (b"x" * 65536 for _ in range(40))), 413)
    assert files(folder) == []


@own_connection
@pytest.mark.slow
@pytest.mark.parametrize("limits", [{}, {"body_seconds": 2}], ids=["leaves", "waits"])
def test_a_file_that_stops_coming_leaves_nothing(folder: Path, limits: dict[str, Any]):
    """The client disconnects, or the service times out."""
    with serving(folder, uploads=True, **limits) as client:
        head = b"POST /scenes?name=walk HTTP/1.1\r\nHost: x\r\nContent-Length: 5000\r\n\r\n"
        with connect(client, head + b"half a scene") as connection:
            eventually(lambda: len(files(folder)) == 1)
            if limits:
                assert connection.recv(65536).startswith(b"HTTP/1.1 408 ")
        eventually(lambda: files(folder) == [])


def test_without_uploads_nothing_is_added_or_deleted(folder: Path, file: bytes):
    write_scene(folder / "walk.onnx")
    with serving(folder) as client:
        for response in (add(client, file, "jump"), client.delete("/scenes/walk")):
            check_problem(response, 403)
    assert files(folder) == ["walk.onnx"]


def test_old_files_of_a_killed_process_are_removed(folder: Path):
    (folder / ".incoming-old").write_bytes(b"half a scene")
    os.utime(folder / ".incoming-old", (0, 0))
    (folder / ".incoming-new").write_bytes(b"another service receives it")
    write_scene(folder / "walk.onnx")
    with serving(folder, uploads=True) as client:
        assert client.get("/scenes").json()["scenes"][0]["name"] == "walk"
        eventually(lambda: files(folder) == [".incoming-new", "walk.onnx"])


@in_this_process
def test_files_are_reloaded_where_old_ones_cannot_be_removed(folder: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(SceneStore, "clear_incoming", Mock(side_effect=PermissionError))
    write_scene(folder / "walk.onnx")
    with serving(folder, uploads=True) as client:
        assert client.post("/render", json=FRAME).status_code == 200
        blue = write_scene(folder / "walk.onnx", static_color=(0, 0, 1)).read_bytes()
        eventually(lambda: client.get("/scenes/walk").json()["sha256"] == hashlib.sha256(blue).hexdigest())


def test_the_time_limit_of_a_part_leaves_out_the_time_to_write_it():
    messages = [{"type": "http.request", "body": each, "more_body": each != b"scene"} for each in (b"a ", b"scene")]

    async def receive() -> dict[str, Any]:
        return messages.pop(0)

    async def received() -> bytes:
        parts = []
        async for part in scenes._parts(Request({"type": "http"}, receive), seconds=0):
            await asyncio.sleep(0)
            parts.append(part)
        return b"".join(parts)

    assert asyncio.run(received()) == b"a scene"


def test_a_file_that_is_removed_while_it_is_received_is_asked_for_again(
    client: httpx.Client, folder: Path, file: bytes
):
    def parts() -> Iterator[bytes]:
        yield file[:100]
        eventually(lambda: len(files(folder)) == 1)
        (folder / files(folder)[0]).unlink()
        yield file[100:]

    response = add(client, parts())
    check_problem(response, 503)
    assert response.headers["Retry-After"]
    assert add(client, file).status_code == 201


@own_connection
def test_the_name_is_checked_before_the_file_is_received(client: httpx.Client, file: bytes):
    assert add(client, file).status_code == 201
    for name, status in (("walk", b"409"), ("a%2Fb", b"422")):
        head = f"POST /scenes?name={name} HTTP/1.1\r\nHost: x\r\nContent-Length: 5000\r\n\r\n"
        with connect(client, head.encode()) as connection:
            assert connection.recv(65536).startswith(b"HTTP/1.1 " + status)


def test_other_web_pages_add_scenes_only_where_they_are_named(folder: Path, file: bytes):
    """Browsers send such a POST without asking the service first."""
    with serving(folder, uploads=True, cors_origins=["https://example.org"]) as client:

        def add_from(origin: str) -> httpx.Response:
            return client.post("/scenes?name=walk&replace=true", content=file, headers={"Origin": origin})

        host = client.base_url.netloc.decode()
        for origin in ("https://example.net", "https://example.org:8000", f"http://{host}.net", "null", host, ""):
            check_problem(add_from(origin), 403)
        assert files(folder) == []
        for origin in ("https://example.org", f"http://{host}", f"https://{host}"):
            assert add_from(origin).status_code == 201, "named, or the service's own page, maybe behind a proxy"

"""Batches: each frame has a response of its own, and equal frames are rendered once."""

import asyncio
import base64
import email
import email.policy
import json
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from msdgs_serve.api.app import create_app
from msdgs_serve.api.errors import MAX_BODY_BYTES
from msdgs_serve.api.routes import batch as route
from msdgs_serve.api.settings import Settings
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.renderer import Renderer
from msdgs_serve.store import SceneStore
from tests.support.scene_files import write_scene
from tests.support.service import FRAME, eventually, serving


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    return Renderer()


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory, renderer: Renderer) -> Iterator[httpx.Client]:
    folder = tmp_path_factory.mktemp("scenes")
    write_scene(folder / "red.onnx")
    write_scene(folder / "blue.onnx", static_color=(0, 0, 1))
    with serving(folder, renderer=renderer, max_batch=20) as client:
        yield client


def batch(client: httpx.Client, frames: list[Any]) -> list[dict[str, Any]]:
    """Return the lines of the response in the order of the frames."""
    response = client.post("/render/batch", json={"frames": frames})
    assert response.status_code == 200, response.text
    assert response.headers["Content-Type"] == "application/x-ndjson"
    return sorted((json.loads(line) for line in response.content.splitlines()), key=lambda line: line["index"])


def test_every_frame_equals_that_of_a_single_request(client: httpx.Client):
    frames = [{**FRAME, "scene": "red"}, {**FRAME, "scene": "blue", "format": "jpeg"}]
    frames += [{**FRAME, "scene": "red", "t": 0.1 * number} for number in range(5)]
    lines = batch(client, frames)
    assert [line["index"] for line in lines] == list(range(7))
    for frame, line in zip(frames, lines, strict=True):
        alone = client.post("/render", json=frame)
        assert (line["status"], line["media_type"]) == (200, alone.headers["Content-Type"])
        assert base64.b64decode(line["data"]) == alone.content


def test_an_invalid_frame_does_not_affect_the_others(client: httpx.Client):
    bad: list[Any] = [
        {**FRAME, "scene": "red", "t": 7},
        {**FRAME, "scene": "green"},
        {**FRAME, "scene": "red", "camera": {"type": "fisheye"}},
        {},
        {**FRAME, "scene": "red", "t": [0.1, 0.2]},
        {**FRAME, "scene": "x" * 100_000},
    ]
    lines = batch(client, [{**FRAME, "scene": "red"}, *bad, {**FRAME, "scene": "blue"}])
    assert [line["status"] for line in lines] == [200, 422, 404, 422, 422, 422, 422, 200]
    fields = [line["problem"]["errors"][0]["field"] for line in lines[1:-1]]
    assert fields == ["t", "scene", "camera.type", "camera", "t", "scene"]
    assert all(len(json.dumps(line["problem"])) <= MAX_BODY_BYTES for line in lines[1:-1])


def test_equal_frames_are_drawn_once(client: httpx.Client, renderer: Renderer, monkeypatch: pytest.MonkeyPatch):
    drawn = []
    original = renderer.render
    monkeypatch.setattr(renderer, "render", lambda *arguments: drawn.append(1) or original(*arguments))
    before = renderer.cache.use
    frames = [{**FRAME, "scene": "red", "t": 0.7 + 0.1 * (number % 2)} for number in range(8)]
    frames += [{**frames[0], "width": 20}]
    lines = batch(client, frames)
    assert [line["status"] for line in lines] == [200] * 9
    assert len(drawn) == 3
    assert renderer.cache.use.misses - before.misses == 2, "two sizes share the pose of one time"
    assert lines[0]["data"] == lines[2]["data"]


def test_a_batch_keeps_no_scenes_in_memory(tmp_path: Path):
    """Each scene is loaded where all others were unloaded, in the check of the frames and in their rendering."""
    opened: list[weakref.ref[DeformationSession]] = []

    def open_scene(path: Path) -> DeformationSession:
        # a thread that has handed over its frame may hold the scene of it for another moment
        eventually(lambda: sum(session() is not None for session in opened) <= 1)
        session = DeformationSession(path)
        opened.append(weakref.ref(session))
        return session

    names = [f"scene {number}" for number in range(4)]
    for number, name in enumerate(names):
        write_scene(tmp_path / f"{name}.onnx", static_color=(number / 4, 0, 0))
    service = create_app(SceneStore([tmp_path], open_scene, max_bytes=1), Renderer(), Settings()).state.service

    async def statuses() -> list[int]:
        frames = [{**FRAME, "scene": name} for name in names]
        return [item.status async for item in route._items(service, frames, multipart=False)]

    assert asyncio.run(statuses()) == [200] * 4
    assert len(opened) == 2 * len(names)
    service.queue.shut_down()


def test_the_same_as_parts(client: httpx.Client):
    frames = [{**FRAME, "scene": "red"}, {**FRAME, "scene": "red", "t": 7}, {**FRAME, "scene": "blue"}]
    accept = "application/x-ndjson; q=0.5, Multipart/Mixed"
    response = client.post("/render/batch", json={"frames": frames}, headers={"Accept": accept})
    head = f"Content-Type: {response.headers['Content-Type']}\r\n\r\n".encode()
    message = email.message_from_bytes(head + response.content, policy=email.policy.HTTP)
    parts = {int(str(part["Msdgs-Index"])): part for part in message.iter_parts()}  # pyright: ignore
    assert [parts[index]["Msdgs-Status"] for index in range(3)] == ["200", "422", "200"]
    alone = client.post("/render", json=frames[2])
    assert parts[2].get_payload(decode=True) == alone.content
    assert parts[2]["ETag"] == alone.headers["ETag"]
    assert parts[1].get_content_type() == "application/problem+json"


@pytest.mark.parametrize(
    "accept",
    ["", "*/*", "multipart/mixed;q=0", "multipart/mixed; q=0.000, */*", "multipart/mixed;q=0.1, application/x-ndjson"],
)
def test_lines_unless_parts_are_wanted(client: httpx.Client, accept: str):
    response = client.post("/render/batch", json={"frames": [{**FRAME, "scene": "red"}]}, headers={"Accept": accept})
    assert response.headers["Content-Type"] == "application/x-ndjson"

"""Calls that need a scope, calls that need no key, and valid files of keys."""

import asyncio
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from starlette.responses import Response
from starlette.types import Receive, Scope, Send

from msdgs_serve.api.body_limit import BodyLimit
from msdgs_serve.api.keys import MAX_BYTES, SCOPES, KeyCheck, read_keys
from msdgs_serve.api.settings import Settings
from msdgs_serve.scene import InvalidInput
from tests.support.scene_files import write_scene
from tests.support.service import FRAME, check_problem, serving

KEYS = {scope: f"{scope}-0123456789abcdef" for scope in SCOPES}
# one call for each scope that has no effect if it is permitted
CALLS = [("POST", "/render", "read"), ("DELETE", "/scenes/nothing", "write"), ("GET", "/metrics", "operate")]
SCOPE_OF_CALL = {
    ("GET", "/render"): "read",
    ("POST", "/render"): "read",
    ("POST", "/render/batch"): "read",
    ("POST", "/render/video"): "read",
    ("GET", "/scenes"): "read",
    ("GET", "/scenes/{name}"): "read",
    ("GET", "/scenes/{name}/file"): "read",
    ("GET", "/scenes/{name}/report"): "read",
    ("POST", "/scenes"): "write",
    ("DELETE", "/scenes/{name}"): "write",
    ("GET", "/metrics"): "operate",
    ("GET", "/live"): None,
    ("GET", "/ready"): None,
}


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("keys") / "keys"
    path.write_text("# by scope\n\n" + "".join(f"{scope} {key}\n" for scope, key in KEYS.items()))
    return path


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory, keys: Path) -> Iterator[httpx.Client]:
    folder = tmp_path_factory.mktemp("scenes")
    write_scene(folder / "balls.onnx")
    with serving(folder, uploads=True, api_keys_file=keys, frame_max_age=60) as client:
        yield client


@pytest.mark.parametrize(("method", "path", "scope"), CALLS)
def test_a_key_opens_its_scope_and_nothing_else(client: httpx.Client, method: str, path: str, scope: str):
    body = FRAME if method == "POST" else None
    for owned, key in KEYS.items():
        response = client.request(method, path, json=body, headers={"Authorization": f"bearer {key}"})
        if owned == scope:
            assert response.status_code == (404 if method == "DELETE" else 200)
        else:
            check_problem(response, 403)
            assert f"`{scope}`" in response.json()["detail"]


def test_without_a_key_nothing_but_health_is_answered(client: httpx.Client):
    read = KEYS["read"]
    paths = client.get("/openapi.json", headers={"X-API-Key": read}).json()["paths"]
    calls = [(method.upper(), path.replace("{name}", "balls")) for path, methods in paths.items() for method in methods]
    calls = [call for call in calls if call[1] not in ("/live", "/ready")]
    assert len(calls) >= 10
    calls += [("GET", "/docs"), ("GET", "/redoc"), ("GET", "/static-offline-docs/swagger-ui.css")]
    calls += [("GET", "/openapi.json"), ("GET", "/nothing"), ("OPTIONS", "/render")]
    for headers in ({}, {"X-API-Key": "wrong"}, {"Authorization": f"Basic {read}"}, {"X-API-Key": read[:-1]}):
        for method, path in calls:
            response = client.request(method, path, headers=headers)
            check_problem(response, 401)
            assert response.headers["WWW-Authenticate"] == "Bearer"
        for path in ("/live", "/ready", "/"):
            assert client.get(path, headers=headers).status_code == 200
            assert client.head(path, headers=headers).status_code == 200


def test_shared_caches_keep_no_frame_that_needs_a_key(client: httpx.Client):
    response = client.get("/render?width=16&height=16", headers={"X-API-Key": KEYS["read"]})
    assert response.headers["Cache-Control"] == "private, max-age=60"
    assert response.headers["Vary"] == "Authorization, X-API-Key"


def test_under_a_prefix_paths_mean_the_same(keys: Path):
    async def inside(scope: Scope, receive: Receive, send: Send) -> None:
        await Response(status_code=204)(scope, receive, send)

    app = BodyLimit(KeyCheck(inside, read_keys(keys)), max_bytes=4, seconds=5, streamed=[("POST", "/live")])
    transport = httpx.ASGITransport(app, root_path="/scenes")

    async def status(method: str, path: str, body: bytes = b"") -> int:
        async with httpx.AsyncClient(transport=transport, base_url="http://service") as client:
            return (await client.request(method, path, content=body)).status_code

    assert asyncio.run(status("GET", "/scenes/live")) == asyncio.run(status("GET", "/live")) == 204
    assert asyncio.run(status("GET", "/scenes/render")) == asyncio.run(status("GET", "/other/live")) == 401
    assert asyncio.run(status("POST", "/scenes/live", b"12345")) == 204
    assert asyncio.run(status("POST", "/scenes/ready", b"12345")) == 413


def test_uploads_need_the_scope_write(client: httpx.Client, file: bytes):
    for scope, status in (("read", 403), ("operate", 403), ("write", 201)):
        headers = {"X-API-Key": KEYS[scope]}
        assert client.post("/scenes?name=walk", content=file, headers=headers).status_code == status
    for scope, status in (("read", 403), ("operate", 403), ("write", 204)):
        assert client.delete("/scenes/walk", headers={"X-API-Key": KEYS[scope]}).status_code == status


def test_every_call_of_the_document_needs_its_scope(client: httpx.Client):
    document = client.get("/openapi.json", headers={"X-API-Key": KEYS["read"]}).json()
    described = {
        (method.upper(), path): call for path, calls in document["paths"].items() for method, call in calls.items()
    }
    assert described.keys() == SCOPE_OF_CALL.keys()
    for (method, path), scope in SCOPE_OF_CALL.items():
        call = described[method, path]
        assert list(call.get("security", ())) == ([] if scope is None else [{"bearer": [scope]}, {"key": [scope]}])
        assert scope is None or {"401", "403"} <= call["responses"].keys()
        for owned, key in KEYS.items():
            response = client.request(method, path.replace("{name}", "nothing"), headers={"X-API-Key": key})
            assert (response.status_code == 403) == (scope not in (None, owned)), (method, path, owned)
            assert response.status_code != 401


def test_a_key_may_have_several_scopes(tmp_path: Path):
    (tmp_path / "keys").write_text("read,write  0123456789abcdef\noperate\tfedcba9876543210\n")
    assert [key.scopes for key in read_keys(tmp_path / "keys")] == [{"read", "write"}, {"operate"}]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0123456789abcdef", "line 1` must be `scopes key`, as in `read,write,operate .*, got a key without scopes"),
        ("# ours\nread 0123456789abcdef\nfedcba9876543210\n", "line 3"),
        ("admin 0123456789abcdef", "line 1"),
        ("read,,write 0123456789abcdef", "line 1"),
        ("read 0123456789abcde", "16 or more characters"),
        ("read 0123456789abcdef extra", "line 1"),
        ("read 0123456789abcdef\nwrite 0123456789abcdef", "different keys"),
        ("", "0 keys"),
        ("\n# nothing\n", "0 keys"),
    ],
)
def test_a_file_without_scopes_is_refused_with_an_example(tmp_path: Path, text: str, message: str):
    (tmp_path / "keys").write_text(text)
    with pytest.raises(InvalidInput, match=message) as error:
        read_keys(tmp_path / "keys")
    assert "0123456789" not in str(error.value)


def test_key_files_must_be_text(tmp_path: Path):
    (tmp_path / "keys").write_bytes(b"\xff\xfe")
    for path in (tmp_path / "keys", tmp_path / "missing", tmp_path):
        with pytest.raises(InvalidInput, match="a readable text file"):
            read_keys(path)


def test_key_files_of_windows_and_too_large_ones(tmp_path: Path):
    keys, line = tmp_path / "keys", f"read {'k' * 40}\n"
    keys.write_bytes(b"\xef\xbb\xbf" + line.replace("\n", "\r\n").encode())
    assert [key.scopes for key in read_keys(keys)] == [{"read"}]
    keys.write_text(line + "#" * MAX_BYTES)
    with pytest.raises(InvalidInput, match="`api_keys_file` must be at most"):
        read_keys(keys)


def test_an_empty_variable_counts_as_unset(monkeypatch: pytest.MonkeyPatch):
    """docker/compose.yaml sets it even if there are no keys."""
    monkeypatch.setenv("MSDGS_API_KEYS_FILE", "")
    assert Settings().api_keys_file is None

"""Downloads of scene files: the given bytes, whole or visibly cut off."""

import contextlib
import hashlib
import socket
from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest

from tests.support.scene_files import write_scene
from tests.support.service import check_problem, connect, eventually, own_connection, rest_of, serving

NAME = 'a "b"; 50% – it\'s'
PATH = f"/scenes/{NAME.replace('%', '%25')}/file"


@pytest.fixture
def client(folder: Path) -> Iterator[httpx.Client]:
    with serving(folder, uploads=True) as client:
        yield client


@pytest.mark.parametrize("uploaded", [True, False])
def test_the_given_bytes_are_returned(client: httpx.Client, folder: Path, file: bytes, uploaded: bool):
    file += b"\x32\x04mine"  # its doc_string, which the service's own graphs don't have
    if uploaded:
        assert client.post("/scenes", content=file, params={"name": NAME}).status_code == 201
    else:
        (folder / f"{NAME}.onnx").write_bytes(file)
    digest = hashlib.sha256(file).hexdigest()
    response = client.get(PATH)
    assert response.content == file
    assert response.headers["Content-Length"] == str(len(file))
    assert response.headers["ETag"] == f'"{digest}"'
    assert response.headers["Content-Type"] == "application/octet-stream"
    expected = "attachment; filename*=UTF-8''a%20%22b%22%3B%2050%25%20%E2%80%93%20it%27s.onnx"
    assert response.headers["Content-Disposition"] == expected
    for known in (f'"other", "{digest}"', f'W/"{digest}"'):
        unchanged = client.get(PATH, headers={"If-None-Match": known})
        assert (unchanged.status_code, unchanged.content) == (304, b"")
    assert client.get(PATH, headers={"If-None-Match": '"other"'}).content == file
    assert 'route="/scenes/{name}/file",status="304"' in client.get("/metrics").text


def large_scene(path: Path) -> bytes:
    """A scene file that doesn't fit into the buffers of a connection."""
    hidden = path.with_suffix(".hidden")
    contents = write_scene(hidden).read_bytes()
    doc_string = b"\x32\x80\x80\x80\x08" + np.random.default_rng(0).bytes(1 << 24)
    hidden.write_bytes(contents + doc_string)
    hidden.rename(path)
    return contents + doc_string


@contextlib.contextmanager
def begun(client: httpx.Client) -> Iterator[tuple[socket.socket, bytes]]:
    """A connection on which a download has begun, and its first bytes."""
    with connect(client, b"GET /scenes/walk/file HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n") as connection:
        yield connection, connection.recv(65536)


@own_connection
@pytest.mark.parametrize("change", ["replaced", "deleted", "overwritten"])
def test_a_download_is_whole_or_cut_off(client: httpx.Client, folder: Path, tmp_path: Path, change: str):
    path = folder / "walk.onnx"
    old, new = large_scene(path), write_scene(tmp_path / "new.onnx", static_color=(0, 0, 1)).read_bytes()
    with begun(client) as (connection, first):
        if change == "deleted":
            assert client.delete("/scenes/walk").status_code == 204
        elif change == "replaced":
            query = {"name": "walk", "replace": "true"}
            assert client.post("/scenes", content=new, params=query).status_code == 201
        else:
            with path.open("r+b") as file:
                file.seek(len(old) - 1)
                file.write(b"x")
        head, _, body = (first + rest_of(connection)).partition(b"\r\n\r\n")
    assert head.startswith(b"HTTP/1.1 200 ")
    if change == "overwritten":
        assert len(body) < len(old)
    else:
        assert body == old
    if change == "deleted":
        check_problem(client.get("/scenes/walk/file"), 404)
    elif change == "replaced":
        assert client.get("/scenes/walk/file").content == new


def test_a_broken_file_is_not_returned_while_its_old_version_is_served(client: httpx.Client, folder: Path, file: bytes):
    path = folder / f"{NAME}.onnx"
    path.write_bytes(file)
    assert client.get(PATH).content == file
    path.write_bytes(b"no scene")
    statuses = []
    eventually(lambda: statuses.append(client.get(PATH)) or "invalid" in statuses[-1].text)
    assert client.get(PATH.removesuffix("/file")).status_code == 200
    for response in statuses:
        check_problem(response, 503)
        assert ("Retry-After" in response.headers) == (response is not statuses[-1])
    check_problem(client.get("/scenes/nothing/file"), 404)

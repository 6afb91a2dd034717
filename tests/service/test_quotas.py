"""Quotas of uploads, in all and by key, and free disk space."""

import errno
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from msdgs_serve.api import uploads
from msdgs_serve.api.server import Server
from msdgs_serve.api.settings import Settings
from tests.support.scene_files import write_scene
from tests.support.service import check_problem, in_this_process, serving

ONE, TWO = "one-0123456789abcdef", "two-0123456789abcdef"
MIB = 1 << 20


@pytest.fixture
def keys(tmp_path: Path) -> Path:
    (tmp_path / "keys").write_text(f"read,write {ONE}\nread,write {TWO}\n")
    return tmp_path / "keys"


def add(client: httpx.Client, content: Any, name: str, key: str = ONE, **query: Any) -> int:
    response = client.post("/scenes", content=content, params={"name": name, **query}, headers={"X-API-Key": key})
    if response.status_code != 201:
        check_problem(response)
    return response.status_code


def delete(client: httpx.Client, name: str) -> int:
    return client.delete(f"/scenes/{name}", headers={"X-API-Key": TWO}).status_code


def left(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir() if not path.name.endswith(".owner")}


def test_so_many_scenes_in_all(folder: Path, file: bytes):
    with serving(folder, uploads=True, max_scenes=2) as client:
        assert [add(client, file, name) for name in ("a", "b", "c")] == [201, 201, 507]
        assert add(client, file, "a", replace=True) == 201, "a replaced scene is not counted"
        assert delete(client, "b") == 204
        assert add(client, file, "c") == 201
    assert left(folder) == {"a.onnx", "c.onnx"}


def test_so_many_bytes_in_all(folder: Path, file: bytes):
    (folder / "theirs.onnx").write_bytes(b"x" * (MIB - len(file) - 100))
    with serving(folder, uploads=True, max_scenes_megabytes=1) as client:
        assert [add(client, file, name) for name in ("a", "b")] == [201, 507]
        assert add(client, file + b"x" * 101, "a", replace=True) == 507
        assert add(client, file, "a", replace=True) == 201
    assert left(folder) == {"a.onnx", "theirs.onnx"}


def test_so_many_scenes_of_a_key_also_after_a_new_start(folder: Path, file: bytes, keys: Path):
    write_scene(folder / "theirs.onnx")
    settings = {"uploads": True, "max_key_scenes": 2, "api_keys_file": keys}
    with serving(folder, **settings) as client:
        assert [add(client, file, name) for name in ("a", "b", "c")] == [201, 201, 507]
    with serving(folder, **settings) as client:
        assert add(client, file, "c") == 507
        assert add(client, file, "c", TWO) == 201
        assert delete(client, "a") == 204
        assert add(client, file, "d") == 201
        assert add(client, file, "d", TWO, replace=True) == 201, "replacing a scene makes the key its owner"
        assert add(client, file, "e") == 201
    assert ONE not in "".join(path.read_text() for path in folder.glob(".*.owner"))


def test_a_scene_that_is_added_while_its_name_is_deleted_keeps_its_owner(folder: Path):
    counted = uploads.Uploads(folder, Settings())
    write_scene(folder / "a.onnx")
    counted.added(uploads.Stored("a", ONE))
    counted.removed("a")
    assert (folder / ".a.owner").read_text() == ONE
    (folder / "a.onnx").unlink()
    counted.removed("a")
    assert list(folder.iterdir()) == []


def test_so_many_bytes_of_a_key(folder: Path, file: bytes, keys: Path):
    settings = {"uploads": True, "max_key_megabytes": 1, "api_keys_file": keys}
    with serving(folder, **settings) as client:
        assert add(client, b"x" * (MIB + 1), "a") == 507
        assert add(client, file, "a") == 201
    assert left(folder) == {"a.onnx"}


def test_uploads_in_progress_are_counted(folder: Path, file: bytes):
    with serving(folder, uploads=True, max_scenes=1) as client:
        statuses = []

        def parts() -> Iterator[bytes]:
            yield file[:100]
            with httpx.Client(base_url=client.base_url, timeout=60) as other:
                statuses.append(add(other, file, "b"))
            yield file[100:]

        assert add(client, parts(), "a") == 201
        assert statuses == [507]


@in_this_process
def test_so_much_of_the_disk_is_left(folder: Path, file: bytes, monkeypatch: pytest.MonkeyPatch):
    usage, disk = shutil.disk_usage(folder), 10 * MIB

    def free(_: Path) -> Any:
        return usage._replace(free=disk - sum(path.stat().st_size for path in folder.iterdir()))

    monkeypatch.setattr(uploads.shutil, "disk_usage", free)
    with serving(folder, uploads=True, min_free_megabytes=10) as client:
        assert add(client, file, "a") == 507
        disk += MIB
        assert add(client, file, "a") == 201
        assert add(client, b"x" * (MIB + 1), "b") == 507
    assert left(folder) == {"a.onnx"}


@in_this_process
@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT])
def test_a_full_disk_is_a_507(folder: Path, file: bytes, monkeypatch: pytest.MonkeyPatch, number: int):
    servers: list[Server] = []

    def full(*_: object, **__: object) -> None:
        raise OSError(number, "no space")

    with serving(folder, uploads=True, server=servers) as client:
        store = servers[0].service.store
        original: Callable[..., Any] = store.add
        monkeypatch.setattr(store, "add", full)
        assert add(client, file, "a") == 507
        monkeypatch.setattr(store, "add", original)
        assert add(client, file, "a") == 201
    assert left(folder) == {"a.onnx"}

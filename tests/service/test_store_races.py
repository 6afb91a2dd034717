"""Scene files that can't be read for a while, and folders that several processes use."""

import logging
import os
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from msdgs_serve import store as store_module
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.scene import SceneFileInvalid
from msdgs_serve.store import RETRY_SECONDS, SceneExists, SceneStore
from tests.support.scene_files import write_scene


class Clock:
    """Replaces the time of the store."""

    def __init__(self) -> None:
        self.now = 0.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(store_module, "time", clock)
    return clock


def wrapped(path: Path) -> SceneFileInvalid:
    """The error of a session that can't read its file."""
    try:
        raise SceneFileInvalid(path.name, "file", "can't be read") from OSError(5, "Input/output error")
    except SceneFileInvalid as error:
        return error


@pytest.mark.parametrize("made", [lambda _: OSError(5, "Input/output error"), lambda _: MemoryError(), wrapped])
@pytest.mark.parametrize("was_loaded", [False, True])
def test_a_file_that_can_not_be_read_for_a_while_is_tried_again(
    tmp_path: Path, clock: Clock, caplog: pytest.LogCaptureFixture, made: Any, was_loaded: bool
):
    caplog.set_level(logging.ERROR, "msdgs_serve")
    path = write_scene(tmp_path / "walk.onnx")
    open_scene = Mock(side_effect=DeformationSession)
    store = SceneStore([tmp_path], open_scene)
    if was_loaded:
        store.get("walk")
        os.utime(path, (0, 0))
    open_scene.side_effect = made(path)
    if was_loaded:
        store.refresh()
    else:
        with pytest.raises(SceneFileInvalid, match="can't be read"):
            store.get("walk")
    tries = open_scene.call_count
    clock.now += RETRY_SECONDS - 1
    store.refresh()
    assert open_scene.call_count == tries
    assert store.status("walk").problem is not None
    clock.now += 1
    open_scene.side_effect = DeformationSession
    store.refresh()
    assert store.status("walk").problem is None
    assert store.get("walk").name == "walk"
    clock.now += RETRY_SECONDS
    store.refresh()
    assert open_scene.call_count == tries + 1
    assert caplog.records == []


def test_a_file_that_violates_the_contract_is_not_tried_again(tmp_path: Path, clock: Clock):
    (tmp_path / "walk.onnx").write_bytes(b"no scene")
    open_scene = Mock(side_effect=DeformationSession)
    store = SceneStore([tmp_path], open_scene)
    for _ in range(3):
        with pytest.raises(SceneFileInvalid):
            store.get("walk")
        clock.now += 2 * RETRY_SECONDS
        store.refresh()
    assert open_scene.call_count == 1


def test_only_one_of_two_processes_adds_a_scene_of_a_name(folder: Path):
    other = SceneStore([folder])

    def open_scene(path: Path) -> DeformationSession:
        if not (folder / "walk.onnx").exists():
            other.add("walk", write_scene(other.incoming("other"), plan="prefix:1"))
        return DeformationSession(path)

    store = SceneStore([folder], open_scene)
    with pytest.raises(SceneExists):
        store.add("walk", write_scene(store.incoming("token")))
    assert store.get("walk").sha256 == other.get("walk").sha256
    replaced = store.add("walk", write_scene(store.incoming("again")), replace=True)
    assert replaced.sha256 != other.get("walk").sha256
    store.incoming("token").unlink()
    assert [path.name for path in folder.iterdir()] == ["walk.onnx"]


def test_scenes_are_added_where_files_can_not_be_linked(folder: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(os, "link", Mock(side_effect=PermissionError(1, "Operation not permitted")))
    store = SceneStore([folder])
    store.add("walk", write_scene(store.incoming("token")))
    assert [path.name for path in folder.iterdir()] == ["walk.onnx"]

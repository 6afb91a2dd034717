"""Scenes on disk: found, opened once, reloaded when they change, kept when the new file is broken."""

import hashlib
import os
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from msdgs_serve.deformation import DeformationSession
from msdgs_serve.scene import InvalidInput, SceneFileInvalid, SceneNotFound
from msdgs_serve.store import SceneStore
from tests.support.scene_files import write_scene


def change(path: Path, **changes: Any) -> None:
    """Replace a scene file atomically."""
    new = path.with_suffix(".new")
    write_scene(new, **changes)
    os.replace(new, path)


def test_names_are_stems_of_files_and_of_what_folders_hold(tmp_path: Path):
    folder = tmp_path / "scenes"
    folder.mkdir()
    for name in ("walk", "jump", ".unfinished"):
        write_scene(folder / f"{name}.onnx")
    (folder / "notes.txt").write_text("not a scene")
    (folder / "folder.onnx").mkdir()
    alone = write_scene(tmp_path / "alone.onnx")
    assert SceneStore([folder, alone]).names() == ["alone", "jump", "walk"]


def test_a_scene_is_opened_when_first_asked_for_and_once(tmp_path: Path):
    opened = []

    def open_scene(path: Path) -> DeformationSession:
        opened.append(path)
        return DeformationSession(path)

    write_scene(tmp_path / "walk.onnx")
    store = SceneStore([tmp_path], open_scene)
    assert not store.status("walk").loaded
    assert opened == []
    with ThreadPoolExecutor(8) as pool:
        sessions = list(pool.map(lambda _: store.get("walk"), range(8)))
    assert len(set(sessions)) == 1
    assert opened == [tmp_path / "walk.onnx"]
    assert store.status("walk").loaded


def test_a_changed_file_is_loaded_again(tmp_path: Path):
    path = write_scene(tmp_path / "walk.onnx")
    store = SceneStore([path])
    before = store.get("walk")
    change(path, plan="prefix:1")
    assert store.get("walk") is before
    store.refresh()
    after = store.get("walk")
    plans = [served.session.scene.metadata.plan for served in (before, after)]
    assert plans == ["network", "prefix:1"]
    assert before.sha256 != after.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    store.refresh()
    assert store.get("walk") is after


def test_a_file_broken_from_the_start_is_an_error_each_time(tmp_path: Path):
    (tmp_path / "walk.onnx").write_bytes(b"no scene")
    store = SceneStore([tmp_path])
    for _ in range(2):
        with pytest.raises(SceneFileInvalid, match=r"walk\.onnx"):
            store.get("walk")
    assert not store.status("walk").loaded


def test_a_broken_file_is_not_read_again_until_it_changes(tmp_path: Path):
    tries = []

    def open_scene(path: Path) -> DeformationSession:
        tries.append(path)
        raise PermissionError(13, "Permission denied")

    path = write_scene(tmp_path / "walk.onnx")
    store = SceneStore([path], open_scene)
    for _ in range(3):
        with pytest.raises(SceneFileInvalid, match="Permission denied"):
            store.get("walk")
    assert len(tries) == 1


def test_others_are_served_the_old_scene_while_one_loads_the_new(tmp_path: Path):
    loading, go_on = threading.Event(), threading.Event()

    def open_scene(path: Path) -> DeformationSession:
        if loading.is_set():
            raise AssertionError("loaded twice")
        if store_has_scene:
            loading.set()
            assert go_on.wait(60)
        return DeformationSession(path)

    store_has_scene = False
    path = write_scene(tmp_path / "walk.onnx")
    store = SceneStore([path], open_scene)
    before = store.get("walk")
    store_has_scene = True
    change(path, plan="prefix:1")
    with ThreadPoolExecutor(1) as pool:
        slow = pool.submit(store.refresh)
        assert loading.wait(60)
        assert store.get("walk") is before
        store.refresh()
        assert store.get("walk") is before
        go_on.set()
        slow.result(60)
    assert store.get("walk").session.scene.metadata.plan == "prefix:1"


def test_files_come_and_go(tmp_path: Path):
    store = SceneStore([tmp_path])
    assert store.names() == []
    path = write_scene(tmp_path / "walk.onnx")
    store.get("walk")
    path.unlink()
    for call in (store.get, store.status):
        with pytest.raises(SceneNotFound):
            call("walk")
    write_scene(path)
    assert not store.status("walk").loaded


@pytest.mark.parametrize(
    "name", ["", "jump", "../walk", "scenes/walk", "walk.onnx", "/etc/passwd", "walk\0", ".", ".."]
)
def test_only_names_of_scenes_open_anything(tmp_path: Path, name: str):
    folder = tmp_path / "scenes"
    folder.mkdir()
    write_scene(folder / "walk.onnx")
    write_scene(tmp_path / "walk.onnx")
    with pytest.raises(SceneNotFound, match="walk"):
        SceneStore([folder]).get(name)


def test_files_with_separators_in_their_names_are_refused(tmp_path: Path):
    path = write_scene(tmp_path / "a\\b.onnx")
    assert SceneStore([tmp_path]).names() == []
    with pytest.raises(InvalidInput, match="unhidden names"):
        SceneStore([path])


def test_two_files_of_one_name_are_refused(tmp_path: Path):
    (tmp_path / "other").mkdir()
    paths = [write_scene(tmp_path / "walk.onnx"), write_scene(tmp_path / "other" / "walk.onnx")]
    with pytest.raises(InvalidInput, match="different names"):
        SceneStore(paths)
    assert SceneStore([paths[0], paths[0]]).names() == ["walk"]


@pytest.mark.parametrize(
    ("name", "hint"), [("nothing.onnx", "does not exist"), ("model.pt", "to_onnx"), ("a.txt", "a.txt")]
)
def test_paths_that_are_no_scenes_are_refused_with_a_reason(tmp_path: Path, name: str, hint: str):
    if name != "nothing.onnx":
        (tmp_path / name).touch()
    with pytest.raises(InvalidInput, match=hint) as error:
        SceneStore([tmp_path / name])
    assert error.value.field == "paths"


def incoming(store: SceneStore, **changes: Any) -> Path:
    """Write a scene file as an upload does before it is added."""
    return write_scene(store.incoming("token"), **changes)


def test_a_broken_upload_replaces_nothing(tmp_path: Path):
    store = SceneStore([tmp_path])
    before = store.add("walk", incoming(store))
    path = incoming(store)
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(SceneFileInvalid):
        store.add("walk", path, replace=True)
    assert store.get("walk") is before
    assert store.status("walk").problem is None


def test_a_scene_that_is_removed_is_gone(tmp_path: Path):
    folder = tmp_path / "scenes"
    folder.mkdir()
    alone = write_scene(tmp_path / "alone.onnx")
    store = SceneStore([folder, alone])
    store.add("walk", incoming(store))
    store.remove("walk")
    assert store.names() == ["alone"]
    with pytest.raises(SceneNotFound):
        store.remove("walk")
    with pytest.raises(InvalidInput, match="folder for uploads"):
        store.remove("alone")
    assert alone.exists()


def test_scenes_are_added_to_folders_only(tmp_path: Path):
    with pytest.raises(InvalidInput, match="folder"):
        SceneStore([write_scene(tmp_path / "walk.onnx")]).incoming("token")

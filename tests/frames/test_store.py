"""Scenes on disk: found, opened once, and served while a changed file is loaded."""

import hashlib
import logging
import os
import threading
import time
import unicodedata
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from msdgs_serve.deformation import DeformationSession
from msdgs_serve.scene import InvalidInput, SceneFileInvalid, SceneNotFound
from msdgs_serve.store import INCOMING_SECONDS, SceneExists, SceneStore
from tests.support.scene_files import write_scene


def test_names_are_stems_of_files_and_of_what_folders_hold(folder: Path, tmp_path: Path):
    for name in ("walk", "jump", ".unfinished", "a\\b", "ö" * 101):
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
    assert [status.loaded for status in store.statuses()] == [False]
    store.refresh()
    assert opened == []
    with ThreadPoolExecutor(8) as pool:
        sessions = list(pool.map(lambda _: store.get("walk"), range(8)))
    assert len(set(sessions)) == 1
    assert opened == [tmp_path / "walk.onnx"]
    assert store.status("walk").loaded


def test_scenes_not_requested_for_long_are_unloaded(tmp_path: Path):
    opened = []

    def open_scene(path: Path) -> DeformationSession:
        opened.append(path.stem)
        return DeformationSession(path)

    for name in "abc":
        write_scene(tmp_path / f"{name}.onnx")
    size = SceneStore([tmp_path]).get("a").bytes
    assert size > (tmp_path / "a.onnx").stat().st_size
    store = SceneStore([tmp_path], open_scene, 2 * size)
    for name in "abcaccb":
        assert store.get(name).name == name
    assert opened == ["a", "b", "c", "a", "b"]
    store.refresh()
    assert [status.loaded for status in store.statuses()] == [False, True, True]
    (tmp_path / "b.onnx").write_bytes(b"")
    store.refresh()
    for name in "ac":
        store.get(name)
    assert [status.loaded for status in store.statuses()] == [False, True, True], "the old version of b stays"
    tight = SceneStore([tmp_path], open_scene, 1)
    with ThreadPoolExecutor(8) as pool:
        assert [scene.name for scene in pool.map(tight.get, list("ac" * 50))] == list("ac" * 50)
    assert sum(status.loaded for status in tight.statuses()) == 1


def test_a_broken_file_is_not_read_again_until_it_changes(tmp_path: Path):
    tries = []

    def open_scene(path: Path) -> DeformationSession:
        tries.append(path)
        raise SceneFileInvalid(path.name, "means", "holds NaN")

    path = write_scene(tmp_path / "walk.onnx")
    store = SceneStore([path], open_scene)
    for _ in range(3):
        with pytest.raises(SceneFileInvalid, match="holds NaN"):
            store.get("walk")
    assert len(tries) == 1


def test_others_are_served_the_old_scene_while_one_loads_the_new(tmp_path: Path):
    loading, go_on, opened = threading.Event(), threading.Event(), []

    def open_scene(path: Path) -> DeformationSession:
        opened.append(path)
        if len(opened) == 2:
            loading.set()
            assert go_on.wait(60)
        return DeformationSession(path)

    path = write_scene(tmp_path / "walk.onnx")
    store = SceneStore([path], open_scene)
    before = store.get("walk")
    write_scene(tmp_path / "new", plan="prefix:1").replace(path)
    with ThreadPoolExecutor(1) as pool:
        slow = pool.submit(store.refresh)
        assert loading.wait(60)
        assert store.get("walk") is before
        store.refresh()
        assert store.get("walk") is before
        go_on.set()
        slow.result(60)
    after = store.get("walk")
    assert after.session.scene.metadata.plan == "prefix:1"
    assert before.sha256 != after.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    store.refresh()
    assert store.get("walk") is after
    assert len(opened) == 2


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
def test_only_names_of_scenes_open_anything(folder: Path, tmp_path: Path, name: str):
    write_scene(folder / "walk.onnx")
    write_scene(tmp_path / "walk.onnx")
    with pytest.raises(SceneNotFound, match="walk"):
        SceneStore([folder]).get(name)


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("nothing.onnx", "does not exist"),
        ("model.pt", "msdgs-export"),
        ("a.txt", "a.txt"),
        ("a\\b.onnx", "unhidden names"),
        ("other/walk.onnx", "different names"),
    ],
)
def test_paths_that_are_no_scenes_are_refused_with_a_reason(tmp_path: Path, name: str, hint: str):
    walk = write_scene(tmp_path / "walk.onnx")
    assert SceneStore([walk, walk]).names() == ["walk"]
    (tmp_path / "other").mkdir()
    if name != "nothing.onnx":
        (tmp_path / name).touch()
    with pytest.raises(InvalidInput, match=hint) as error:
        SceneStore([walk, tmp_path / name])
    assert error.value.field == "paths"


def test_scenes_are_added_to_and_removed_from_folders_only(folder: Path, tmp_path: Path):
    alone = write_scene(tmp_path / "alone.onnx")
    store = SceneStore([folder, alone])
    store.add("walk", write_scene(store.incoming("token")))
    store.remove("walk")
    assert store.names() == ["alone"]
    with pytest.raises(SceneNotFound):
        store.remove("walk")
    with pytest.raises(InvalidInput, match="folder for uploads"):
        store.remove("alone")
    assert alone.exists()
    with pytest.raises(InvalidInput, match="folder"):
        SceneStore([alone]).incoming("token")


def test_a_scene_that_is_added_hides_none_of_other_folders(
    folder: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    caplog.set_level(logging.WARNING, "msdgs_serve")
    (tmp_path / "ours").mkdir()
    store = SceneStore([folder, tmp_path / "ours"])
    added = store.add("walk", write_scene(store.incoming("token")))
    assert added.session.path.name == "walk.onnx"  # which errors of later poses name
    assert store.get("walk") is added
    ours = write_scene(tmp_path / "ours" / "walk.onnx", plan="prefix:1")
    store.refresh()
    for each in (store, SceneStore([folder, tmp_path / "ours"])):
        assert each.get("walk").signature.path == each.file("walk") == ours
        assert each.names() == ["walk"]
        with pytest.raises(SceneExists):
            each.target("walk", replace=True)
    message = f"{folder / 'walk.onnx'} is not served, as {ours} has its name"
    assert [record.getMessage() for record in caplog.records] == [message] * 2, "once for each start"
    store.remove("walk")
    assert not (folder / "walk.onnx").exists()
    with pytest.raises(InvalidInput):
        store.remove("walk")
    assert store.file("walk") == ours


def test_only_old_temporary_files_are_removed(folder: Path):
    store = SceneStore([folder])
    for token, age in (("old", INCOMING_SECONDS), ("new", 0)):
        store.incoming(token).touch()
        os.utime(store.incoming(token), (0, time.time() - age))
    store.clear_incoming()
    assert list(folder.iterdir()) == [store.incoming("new")]


def test_suffixes_in_capitals_are_named(folder: Path, caplog: pytest.LogCaptureFixture):
    file = write_scene(folder / "walk.onnx").rename(folder / "walk.ONNX")
    assert SceneStore([folder]).names() == []
    assert [record.getMessage() for record in caplog.records] == [
        f"{file} is not served, as its name doesn't end with .onnx in small letters"
    ]
    with pytest.raises(InvalidInput, match="not in small letters"):
        SceneStore([file])


def test_a_name_in_another_unicode_form_is_explained(folder: Path):
    composed, decomposed = (unicodedata.normalize(form, "café") for form in ("NFC", "NFD"))
    write_scene(folder / f"{decomposed}.onnx")
    store = SceneStore([folder])
    assert store.get(decomposed).name == decomposed
    with pytest.raises(SceneNotFound, match="looks the same"):
        store.get(composed)
    with pytest.raises(SceneNotFound) as error:
        store.get("cafe")
    assert "looks the same" not in str(error.value)

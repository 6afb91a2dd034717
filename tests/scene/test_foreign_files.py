"""Files that people give in place of a scene are called by what they are, with the command that turns them into one."""

import gzip
import io
import re
import zipfile
from pathlib import Path

import pytest

from msdgs_serve.render_cli import main as render
from msdgs_serve.scene.errors import InvalidInput, SceneFileInvalid
from msdgs_serve.scene.foreign import TEXT, foreign_file, is_lfs_pointer
from msdgs_serve.scene.onnx import UNLIMITED
from msdgs_serve.scene.scene_file import read_scene_file
from msdgs_serve.store import SceneStore
from tests.support.scene_files import write_scene

POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:" + b"0f" * 32 + b"\nsize 9\n"


def zip_of(name: str) -> bytes:
    contents = io.BytesIO()
    with zipfile.ZipFile(contents, "w") as archive:
        archive.writestr(name, b"contents")
    return contents.getvalue()


PLY = b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\nend_header\n\0\0\0\0"
IMPORTED = r"is a {}, not a scene file: `msdgs-export [^`]*{}`"
FILES = {
    "a.ply": (PLY, "splat"),
    "a.compressed.ply": (PLY, "splat"),
    "A.PLY": (PLY.replace(b"\n", b"\r\n"), "splat"),
    "a.ply.gz": (gzip.compress(PLY), "splat"),
    "a.zip": (zip_of("point_cloud.ply"), "splat"),
    "a.sog": (zip_of("meta.json"), "splat"),
    "a.spz": (b"NGSP\3\0\0\0" + bytes(40), "splat"),
    "a.splat": (bytes(range(64)), "splat"),
    "a.ksplat": (bytes(5000), "splat"),
    "model.pt": (zip_of("model/data.pkl"), "model"),
    "model.pth": (b"\x80\x02", "model"),
    "unnamed": (PLY, "splat"),
    "model": (zip_of("archive/data.pkl"), "model"),
}


@pytest.mark.parametrize("name", FILES)
def test_splats_and_models_are_told_of_the_import(tmp_path: Path, name: str):
    contents, what = FILES[name]
    (tmp_path / name).write_bytes(contents)
    message = IMPORTED.format(what, re.escape(name))
    with pytest.raises(SceneFileInvalid, match=message):
        read_scene_file(contents, name, UNLIMITED)
    with pytest.raises(InvalidInput, match=f"got .*, which {message}"):
        SceneStore([tmp_path / name])


@pytest.mark.parametrize("name", ["a.ply", "model.pt", "scene.onnx", "README"])
@pytest.mark.parametrize("pointer", [POINTER, POINTER.replace(b"\n", b"\r\n"), POINTER.replace(b"https", b"http")])
def test_a_pointer_of_git_lfs_is_called_one(tmp_path: Path, name: str, pointer: bytes):
    (tmp_path / name).write_bytes(pointer)
    with pytest.raises(SceneFileInvalid, match=r"is a Git LFS pointer, .*`git lfs pull`"):
        read_scene_file(pointer, name, UNLIMITED)
    if not name.endswith(".onnx"):
        with pytest.raises(InvalidInput, match="which is a Git LFS pointer"):
            SceneStore([tmp_path / name])


@pytest.mark.parametrize("name", ["a.ply", "scene.onnx"])
def test_the_command_says_so_too(tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]):
    (tmp_path / name).write_bytes(PLY)
    assert render([str(tmp_path / name), str(tmp_path / "out")])
    assert re.search(IMPORTED.format("splat", name), capsys.readouterr().err)


def test_a_scene_of_any_name_is_a_scene(tmp_path: Path):
    contents = write_scene(tmp_path / "scene.onnx").read_bytes()
    assert read_scene_file(contents, "scene.zip", UNLIMITED).moving_count


@pytest.mark.parametrize(
    "start",
    [
        b"",
        b"version 1",
        b"plywood",
        b"Pk",
        b'{"camera_path": []}\r\n',
        "Größe\n".encode()[:4],
        b"version https://git-lfs.github.com/spec/v1",
    ],
)
def test_other_texts_are_none_of_these(start: bytes):
    assert foreign_file(start, "scene.onnx") == (TEXT if start else None)
    assert not is_lfs_pointer(start)

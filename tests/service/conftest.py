"""What the tests of uploads share."""

from pathlib import Path

import pytest

from tests.support.scene_files import write_scene


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder for scenes, empty, in an empty one."""
    (tmp_path / "scenes").mkdir()
    return tmp_path / "scenes"


@pytest.fixture
def file(tmp_path: Path) -> bytes:
    """The contents of a valid scene file."""
    return write_scene(tmp_path / "scene.onnx").read_bytes()

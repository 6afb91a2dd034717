"""Fixtures of the tests of uploads."""

from pathlib import Path

import pytest

from tests.support.scene_files import write_scene


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return an empty folder for scenes."""
    (tmp_path / "scenes").mkdir()
    return tmp_path / "scenes"


@pytest.fixture
def file(tmp_path: Path) -> bytes:
    """Return the contents of a valid scene file."""
    return write_scene(tmp_path / "scene.onnx").read_bytes()

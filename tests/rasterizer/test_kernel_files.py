"""Machine code on disk that is damaged, or that can't be written, costs a compilation and never a call."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from msdgs_serve.rasterizer.kernel_files import CheckedFiles, copy_kernels, is_writable
from tests.support.processes import ROOT, run_python

KERNEL = """
from msdgs_serve.rasterizer.jit import kernel

@kernel
def double(x):
    return 2 * x
"""

CALL = """
import sys
sys.path.insert(0, sys.argv[1])
from room.caller import double
print(double(21.0), len(double.stats.cache_misses))
"""


pytestmark = pytest.mark.xdist_group("kernel files")  # one worker, so that the room is compiled once


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("kernels")
    (folder / "room").mkdir()
    (folder / "room" / "caller.py").write_text(KERNEL)
    return folder


@pytest.fixture(scope="module")
def compiled(room: Path) -> Path:
    """A folder of machine code that a process has filled and another one has used."""
    assert call(room, room / "cache") == (42.0, True)
    assert call(room, room / "cache") == (42.0, False)
    return room / "cache"


def call(room: Path, cache: Path | str) -> tuple[float, bool]:
    """Result of the kernel in a process of its own, and whether that process compiled it."""
    value, misses = run_python(CALL, room, NUMBA_CACHE_DIR=str(cache)).split()
    return float(value), misses != "0"


def cut(contents: bytes) -> bytes:
    return contents[: len(contents) // 2]


def flip(contents: bytes) -> bytes:
    middle = len(contents) // 2
    return contents[:middle] + bytes([contents[middle] ^ 1]) + contents[middle + 1 :]


@pytest.mark.parametrize(
    ("suffix", "damage"),
    [(".nbi", cut), (".nbi", lambda _: b""), (".nbc", cut), (".nbc", lambda _: b""), (".nbc", flip)],
    ids=["index cut", "index empty", "code cut", "code empty", "code flipped"],
)
def test_a_damaged_file_is_compiled_anew_and_mended(
    room: Path, compiled: Path, tmp_path: Path, suffix: str, damage: Callable[[bytes], bytes]
):
    cache = tmp_path / "cache"
    shutil.copytree(compiled, cache)
    (file,) = cache.rglob(f"*.double-*{suffix}")
    file.write_bytes(damage(file.read_bytes()))
    assert call(room, cache) == (42.0, True)
    assert call(room, cache) == (42.0, False)


def test_a_folder_that_cannot_be_written_is_no_obstacle(room: Path, tmp_path: Path):
    (tmp_path / "file").touch()
    assert not is_writable(tmp_path / "file" / "cache")
    assert call(room, tmp_path / "file" / "cache") == (42.0, True)


def test_nothing_that_can_be_written_is_no_obstacle(room: Path, tmp_path: Path):
    (tmp_path / "file").touch()
    value = run_python(
        "import tempfile; tempfile.tempdir = '/nonexistent'\n" + CALL.replace(", len(double.stats.cache_misses)", ""),
        room,
        NUMBA_CACHE_DIR=str(tmp_path / "file" / "cache"),
    )
    assert float(value) == 42.0


def test_what_was_compiled_beside_the_sources_is_used_from_the_copy(tmp_path: Path):
    """As in a container with a read-only root: compiled at build, copied at start."""
    package = tmp_path / "msdgs_serve"
    shutil.copytree(ROOT / "msdgs_serve", package, ignore=shutil.ignore_patterns("__pycache__"))
    (package / "room.py").write_text(KERNEL)
    run = f"""
import sys
sys.path.insert(0, {str(tmp_path)!r})
import msdgs_serve
assert msdgs_serve.__file__.startswith({str(tmp_path)!r})
from msdgs_serve.room import double
double(21.0)
print(len(double.stats.cache_misses))
"""
    assert run_python(run, NUMBA_CACHE_DIR="").split() == ["1"]
    copy = tmp_path / "copy"
    copy.mkdir()
    copy_kernels(package, copy, nested=True)
    assert run_python(run, NUMBA_CACHE_DIR=str(copy)).split() == ["0"]
    again = tmp_path / "again"
    copy_kernels(copy, again, nested=False)
    assert run_python(run, NUMBA_CACHE_DIR=str(again)).split() == ["0"]


def files_of(folder: Path, stamp: str = "now") -> CheckedFiles:
    return CheckedFiles(str(folder), "room.kernel", stamp)


def test_code_that_two_processes_store_at_once_is_not_mixed_up(tmp_path: Path):
    """Each has seen an index without the other's code; whichever is written last, no type gets the other's."""
    files_of(tmp_path).save("float32", "code for float32")
    index = (tmp_path / "room.kernel.nbi").read_bytes()
    (tmp_path / "room.kernel.nbi").unlink()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(CheckedFiles, "_remove", lambda *_: None)  # as if the other's file weren't there yet
        files_of(tmp_path).save("float64", "code for float64")
    (tmp_path / "room.kernel.nbi").write_bytes(index)
    assert files_of(tmp_path).load("float32") == "code for float32"
    assert files_of(tmp_path).load("float64") is None
    files_of(tmp_path).save("float64", "code for float64")
    assert [files_of(tmp_path).load(key) for key in ("float32", "float64")] == ["code for float32", "code for float64"]


def test_code_of_older_sources_goes(tmp_path: Path):
    files_of(tmp_path, "before").save("float32", "old code")
    assert files_of(tmp_path).load("float32") is None
    files_of(tmp_path).save("float64", "new code")
    assert len(list(tmp_path.glob("*.nbc"))) == 1
    assert files_of(tmp_path).load("float64") == "new code"


def test_code_whose_file_is_gone_is_compiled_anew(tmp_path: Path):
    files_of(tmp_path).save("float32", "code")
    for file in tmp_path.glob("*.nbc"):
        file.unlink()
    assert files_of(tmp_path).load("float32") is None

"""Files that native code reads are read in a subprocess: crashes, hangs and memory errors end only that process."""

import ctypes
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from msdgs_export.importers import guard
from msdgs_export.importers.errors import ImportFailed
from msdgs_export.importers.guard import read_guarded
from msdgs_export.importers.runs.state import State
from msdgs_export.importers.splats.formats import READERS, UNPACKED, read_splats
from tests.support.splat_files import some_gaussians, write_splats


def crash(path: Path) -> dict[str, np.ndarray]:
    ctypes.string_at(0)
    return {}


def hang(path: Path) -> dict[str, np.ndarray]:
    time.sleep(600)
    return {}


def take_memory(path: Path) -> dict[str, np.ndarray]:
    return {"vast": np.ones(guard.MEMORY)}


def write_much(path: Path) -> dict[str, np.ndarray]:
    with (path.parent / "vast").open("wb") as file:
        file.truncate(2 * guard.MEMORY)
    return {}


def refuse(path: Path) -> dict[str, np.ndarray]:
    raise ImportFailed(path, "has no end")


def print_and_return(path: Path) -> dict[str, np.ndarray]:
    print("what a library has to say")
    return {"size": np.array(path.stat().st_size), "a/b\0\ud800": np.array("text")}


@pytest.mark.parametrize(
    ("read", "problem"),
    [
        (crash, r"a.sog: is damaged: it crashes the process that reads it \(-11\)"),
        (hang, r"a.sog: is damaged: it isn't read within 1 s"),
        (refuse, r"a.sog: has no end$"),
        (write_much, r"a.sog: can't be read: File too large"),
        pytest.param(
            take_memory,
            r"a.sog: is damaged: it crashes the process that reads it \(1\), within a limit of 2,048 MiB",
            marks=pytest.mark.skipif(sys.platform != "linux", reason="other systems don't enforce a memory limit"),
        ),
    ],
)
def test_errors_of_the_subprocess_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, read: Callable[[Path], dict[str, np.ndarray]], problem: str
):
    if read is hang:
        monkeypatch.setattr(guard, "SECONDS", 1.0)
    (tmp_path / "a.sog").touch()
    with pytest.raises(ImportFailed, match=problem):
        read_guarded(read, tmp_path / "a.sog")


def test_arrays_come_back_by_name(tmp_path: Path):
    (tmp_path / "a.sog").write_bytes(bytes(7))
    arrays = read_guarded(print_and_return, tmp_path / "a.sog")
    assert {name: array.item() for name, array in arrays.items()} == {"size": 7, "a/b\0\ud800": "text"}


@pytest.mark.parametrize("file_format", sorted(UNPACKED))
def test_no_splat_file_is_unpacked_in_this_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, file_format: str):
    kind = "spz 4" if file_format.startswith("spz") else file_format
    file = write_splats(tmp_path, kind, some_gaussians(20, 0))
    if kind == "spz 4":
        contents = file.read_bytes()
        file.write_bytes(contents[:31] + b"\1" + contents[32:])  # reserved
    here = READERS[file_format](file)
    assert bool(here.warnings) == (kind == "spz 4")
    monkeypatch.setitem(READERS, file_format, lambda _: pytest.fail("in this process"))
    read = read_splats(file, file_format)
    assert (read.dropped, read.antialiasing, read.warnings) == (here.dropped, here.antialiasing, here.warnings)
    for name, array in here.to_arrays().items():
        assert np.array_equal(read.to_arrays()[name], array), name


def test_no_torch_file_of_others_is_unpacked_in_this_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    values = {"a.weight": torch.rand(3, 2, dtype=torch.float64), "b": torch.tensor([True])}
    torch.save(values, tmp_path / "deform.pth")
    monkeypatch.setattr("msdgs_export.importers.runs.state.load", lambda _: pytest.fail("in this process"))
    state = State(tmp_path / "deform.pth")
    assert torch.equal(state.read("a.weight", None, 2), values["a.weight"].float())
    assert state.read("b", 1).item() == 1

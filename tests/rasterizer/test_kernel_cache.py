"""Machine code on disk is void when any source changes that it was compiled from, and only then."""

import ast
import shutil
from pathlib import Path

import pytest

from tests.support.processes import ROOT, run_python

CALLER = """
import numpy as np
from msdgs_serve.rasterizer.harmonics import harmonics_above_0
from msdgs_serve.rasterizer.jit import kernel
from room.constants import FACTOR

@kernel
def constant_term():
    return FACTOR * harmonics_above_0(0.0, -1.0, 0.0)[0]
"""

CALL = """
import sys
sys.path.insert(0, sys.argv[1])
from room.caller import constant_term
print(constant_term(), len(constant_term.stats.cache_misses))
"""

EDITS = {  # what a kernel of `room` is compiled from, beside its own file
    "kernel": ("msdgs_serve/rasterizer/harmonics.py", "        -SH_C1 * y,", "        -2 * SH_C1 * y,"),
    "constant": ("msdgs_serve/scene/spherical_harmonics.py", "SH_C1 = 0.48", "SH_C1 = 3 * 0.48"),
    "neighbour": ("room/constants.py", "1.0", "5.0"),
}


def test_machine_code_follows_every_source(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    shutil.copytree(ROOT / "msdgs_serve", tmp_path / "msdgs_serve", ignore=shutil.ignore_patterns("__pycache__"))
    room = tmp_path / "room"
    room.mkdir()
    (room / "caller.py").write_text(CALLER)
    (room / "constants.py").write_text("FACTOR = 1.0\n")

    def call() -> tuple[float, bool]:
        """Result of the kernel in a process of its own, and whether that process compiled it."""
        value, misses = run_python(CALL, tmp_path).split()
        return float(value), misses != "0"

    expected, compiled = call()
    assert compiled
    assert call() == (expected, False)
    for (name, old, new), factor in zip(EDITS.values(), (2, 3, 5), strict=True):
        file = tmp_path / name
        source = file.read_text()
        assert old in source
        file.write_text(source.replace(old, new))
        expected *= factor
        value, compiled = call()
        assert compiled
        assert value == pytest.approx(expected, rel=1e-12), f"{name} was changed"


def kernel_files() -> list[Path]:
    files = [path for package in ("msdgs_serve", "msdgs_train") for path in (ROOT / package).rglob("*.py")]
    return [path for path in files if "@kernel" in path.read_text()]


@pytest.mark.parametrize("file", kernel_files(), ids=lambda file: file.stem)
def test_kernels_use_only_what_their_stamp_follows(file: Path):
    """From the package's own modules: the rasterizer, the scene's vocabulary, the kernel's own folder."""
    tree = ast.parse(file.read_text())
    own = ".".join(file.relative_to(ROOT).parent.parts)
    followed = ("msdgs_serve.rasterizer", "msdgs_serve.scene", own)
    origins = {
        alias.asname or alias.name: node.module or ""
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    for function in (node for node in tree.body if isinstance(node, ast.FunctionDef)):
        if any(isinstance(mark, ast.Name) and mark.id == "kernel" for mark in function.decorator_list):
            names = {node.id for node in ast.walk(function) if isinstance(node, ast.Name)}
            for name in names & origins.keys():
                origin = origins[name]
                if origin.startswith("msdgs_"):
                    assert origin.rpartition(".")[0] in followed, f"{function.name} uses {name} of {origin}"

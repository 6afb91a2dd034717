"""Cached machine code: recompiled if a source changes or a file is damaged, complete before the first request."""

import ast
import json
import shutil
import sys
from collections.abc import Callable
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import pytest
from numba.core import config

from msdgs_serve.api.cli import main
from msdgs_serve.process import EXIT_INVALID
from msdgs_serve.rasterizer.kernel_files import CheckedFiles, copy_kernels, is_writable
from tests.support.processes import ROOT, run_python

pytestmark = pytest.mark.slow

KERNEL = """
from msdgs_serve.rasterizer.jit import kernel

@kernel
def double(x):
    return 2 * x
"""

CALL = """
import sys
sys.path.insert(0, sys.argv[1])
from package.caller import double
print(double(21.0), len(double.stats.cache_misses))
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("kernels")
    (folder / "package").mkdir()
    (folder / "package" / "caller.py").write_text(KERNEL)
    return folder


@pytest.fixture
def compiled(folder: Path, tmp_path: Path) -> Path:
    """Return a cache that has been filled and used."""
    assert imported_and_called(folder, tmp_path / "cache") == (42.0, True)
    assert imported_and_called(folder, tmp_path / "cache") == (42.0, False)
    return tmp_path / "cache"


def imported_and_called(folder: Path, cache: Path) -> tuple[float, bool]:
    """Return the result of the kernel, imported anew, and whether it was compiled."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(config, "CACHE_DIR", str(cache))
        spec = spec_from_file_location("caller", folder / "package" / "caller.py")
        assert spec
        assert spec.loader
        module = module_from_spec(spec)
        patch.setitem(sys.modules, "caller", module)
        spec.loader.exec_module(module)
        return module.double(21.0), bool(module.double.stats.cache_misses)


def call(folder: Path, cache: Path | str) -> tuple[float, bool]:
    """Return the kernel's result in a new process, and whether that process compiled it."""
    value, misses = run_python(CALL, folder, NUMBA_CACHE_DIR=str(cache)).split()
    return float(value), misses != "0"


def cut(contents: bytes) -> bytes:
    return contents[: len(contents) // 2]


def flip(contents: bytes) -> bytes:
    middle = len(contents) // 2
    return contents[:middle] + bytes([contents[middle] ^ 1]) + contents[middle + 1 :]


@pytest.mark.parametrize(
    ("suffix", "damage"),
    [(".nbi", cut), (".nbc", flip), (".nbc", None)],
    ids=["index cut", "code flipped", "code missing"],
)
def test_a_damaged_file_is_compiled_again_and_replaced(
    folder: Path, compiled: Path, suffix: str, damage: Callable[[bytes], bytes] | None
):
    (file,) = compiled.rglob(f"*.double-*{suffix}")
    file.write_bytes(damage(file.read_bytes())) if damage else file.unlink()
    assert imported_and_called(folder, compiled) == (42.0, True)
    assert imported_and_called(folder, compiled) == (42.0, False)


def test_a_folder_that_cannot_be_written_is_no_obstacle(folder: Path, tmp_path: Path):
    (tmp_path / "file").touch()
    assert not is_writable(tmp_path / "file" / "cache")
    assert call(folder, tmp_path / "file" / "cache") == (42.0, True)


def test_nothing_that_can_be_written_is_no_obstacle(folder: Path, tmp_path: Path):
    (tmp_path / "file").touch()
    value = run_python(
        "import tempfile; tempfile.tempdir = '/nonexistent'\n" + CALL.replace(", len(double.stats.cache_misses)", ""),
        folder,
        NUMBA_CACHE_DIR=str(tmp_path / "file" / "cache"),
    )
    assert float(value) == 42.0


def test_a_copy_of_compiled_kernels_is_used(tmp_path: Path):
    """As in a container with a read-only root: compiled at build, copied at start."""
    package = tmp_path / "msdgs_serve"
    shutil.copytree(ROOT / "msdgs_serve", package, ignore=shutil.ignore_patterns("__pycache__"))
    (package / "added.py").write_text(KERNEL)
    run = f"""
import sys
sys.path.insert(0, {str(tmp_path)!r})
import msdgs_serve
assert msdgs_serve.__file__.startswith({str(tmp_path)!r})
from msdgs_serve.added import double
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
    return CheckedFiles(str(folder), "added.kernel", stamp)


def test_code_that_two_processes_store_at_once_is_not_mixed_up(tmp_path: Path):
    """Both processes read the index before the other stored its code; no type may get the other's code."""
    files_of(tmp_path).save("float32", "code for float32")
    index = (tmp_path / "added.kernel.nbi").read_bytes()
    (tmp_path / "added.kernel.nbi").unlink()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(CheckedFiles, "_remove", lambda *_: None)  # the other process hasn't written its file yet
        files_of(tmp_path).save("float64", "code for float64")
    (tmp_path / "added.kernel.nbi").write_bytes(index)
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


CALLER_OF_OTHERS = """
import numpy as np
from msdgs_serve.rasterizer.harmonics import harmonics_above_0
from msdgs_serve.rasterizer.jit import kernel
from msdgs_serve.rasterizer.simd.types import NUM_LANES
from package.constants import FACTOR

@kernel
def double(x):
    return FACTOR * NUM_LANES * harmonics_above_0(0.0, -1.0, 0.0)[0] * x
"""

EDITS = {  # sources of a kernel in `package` besides its own file
    "kernel": ("msdgs_serve/rasterizer/harmonics.py", "        -SH_C1 * y,", "        -2 * SH_C1 * y,"),
    "constant": ("msdgs_serve/scene/spherical_harmonics.py", "SH_C1 = 0.48", "SH_C1 = 3 * 0.48"),
    "vectors": ("msdgs_serve/rasterizer/simd/types.py", "NUM_LANES = 16", "NUM_LANES = 112"),
    "neighbour": ("package/constants.py", "1.0", "5.0"),
}


def test_machine_code_follows_every_source(tmp_path: Path):
    shutil.copytree(ROOT / "msdgs_serve", tmp_path / "msdgs_serve", ignore=shutil.ignore_patterns("__pycache__"))
    folder = tmp_path / "package"
    folder.mkdir()
    (folder / "caller.py").write_text(CALLER_OF_OTHERS)
    (folder / "constants.py").write_text("FACTOR = 1.0\n")

    expected, compiled = call(tmp_path, tmp_path / "cache")
    assert compiled
    assert call(tmp_path, tmp_path / "cache") == (expected, False)
    for (name, old, new), factor in zip(EDITS.values(), (2, 3, 7, 5), strict=True):
        file = tmp_path / name
        source = file.read_text()
        assert old in source
        file.write_text(source.replace(old, new))
        expected *= factor
        value, compiled = call(tmp_path, tmp_path / "cache")
        assert compiled
        assert value == pytest.approx(expected, rel=1e-12), f"{name} was changed"


def kernel_files() -> list[Path]:
    files = [path for package in ("msdgs_serve", "msdgs_train") for path in (ROOT / package).rglob("*.py")]
    return [path for path in files if "@kernel" in path.read_text()]


@pytest.mark.parametrize("file", kernel_files(), ids=lambda file: file.stem)
def test_kernels_use_only_what_their_stamp_follows(file: Path):
    """Kernels use modules of the rasterizer, its vectors, the scene and their own folder only."""
    tree = ast.parse(file.read_text())
    own = ".".join(file.relative_to(ROOT).parent.parts)
    followed = ("msdgs_serve.rasterizer", "msdgs_serve.rasterizer.simd", "msdgs_serve.scene", own)
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
                    packages = {origin, origin.rpartition(".")[0]}  # a module of the package, or a name in a module
                    assert packages & {*followed}, f"{function.name} uses {name} of {origin}"


FRAMES = """
import dataclasses, json, sys
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.rasterizer.precompile import compile_kernels
from msdgs_serve.renderer import Renderer, RenderOptions, Shutter
from msdgs_serve.threads import sharing_cores
from tests.rasterizer.test_rasterizer_threads import kernels

def compiled():
    return {f"{kernel.__module__}.{kernel.__name__}": sorted(map(str, kernel.signatures)) for kernel in kernels()}

compile_kernels()
precompiled = compiled()
session, renderer = DeformationSession(sys.argv[1]), Renderer()
camera = session.scene.metadata.cameras[0].camera.resized(40, 30)
for model in ("pinhole", "orthographic", "fisheye"):
    view = dataclasses.replace(camera, model=model)
    for options in (
        RenderOptions(),
        RenderOptions(depth=True, counts=True),
        RenderOptions(background="transparent"),
        RenderOptions(background=(1.0, 0.5, 0.0), motion_dt=0.1),
        RenderOptions(shutter=Shutter(0.0, 0.1, 3)),
    ):
        renderer.render(session, view, 0.5, options)
with sharing_cores():  # with two callers at once, each computes on one thread
    renderer.render(session, camera, 0.5)
print(json.dumps([precompiled, compiled()]))
"""


def test_frames_need_no_kernel_beyond_those_compiled_ahead() -> None:
    precompiled, after = json.loads(run_python(FRAMES, ROOT / "examples" / "toys.onnx"))
    assert precompiled["msdgs_serve.rasterizer.projection._project_parts"]
    assert precompiled["msdgs_serve.rasterizer.compositing._composite_tiles"]
    assert after == precompiled


def test_kernels_run_without_the_compiler() -> None:
    """The kernels' tests also pass without the compiler, and cover nearly all lines."""
    run_python("import sys; from tests.rasterizer.kernel_coverage import main; sys.exit(main())")


def test_compiling_says_where_the_kernels_are() -> None:
    printed = run_python("from msdgs_serve.api.cli import main; main(['--compile'])", NUMBA_CACHE_DIR="")
    folder = Path(printed.rsplit(" in ", 1)[1].strip())
    assert list(folder.glob("rasterizer/__pycache__/compositing._composite_tiles-*.nbc"))


def test_compiling_for_nothing_is_refused(tmp_path: Path, capsys, monkeypatch) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file" / "kernels"))
    assert main(["--compile"]) == EXIT_INVALID
    assert "can't be written" in capsys.readouterr().err

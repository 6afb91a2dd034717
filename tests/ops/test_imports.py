"""Which package may import which: checked in the sources by import-linter, and in fresh interpreters; no circles."""

import ast
import json
import subprocess
import sys
from collections.abc import Iterator, Set
from graphlib import CycleError, TopologicalSorter
from importlib.util import resolve_name
from pathlib import Path

import pytest

from tests.support.processes import ROOT, run_python

pytestmark = pytest.mark.slow

HEAVY = {"numpy", "numba", "onnxruntime", "OpenImageIO", "fastapi", "pydantic", "torch"}
HTTP = {"fastapi", "starlette", "uvicorn", "pydantic", "pydantic_settings"}
NOT_FOR_SERVING = {"torch", "onnx", "msdgs_train", "msdgs_export", "matplotlib", "tyro", "rich", "zstandard"}

IMPORT_ALL = """
import importlib, pkgutil, msdgs_serve
names = [m.name for m in pkgutil.walk_packages(msdgs_serve.__path__, "msdgs_serve.") if not m.name.startswith({skip!r})]
for name in names:
    importlib.import_module(name)
"""


def modules_after(code: str) -> set[str]:
    """Return the top-level modules that a fresh interpreter has loaded after running `code`."""
    report = "\nimport json, sys; print(json.dumps(sorted({name.partition('.')[0] for name in sys.modules})))"
    return set(json.loads(run_python(code + report)))


def test_import_contracts_hold() -> None:
    command = [Path(sys.executable).with_name("lint-imports"), "--no-cache"]
    finished = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600, check=False)
    assert finished.returncode == 0, finished.stdout + finished.stderr


def import_graph(package: Path) -> dict[str, set[str]]:
    """Return the modules of a package, and which of them each imports, in functions and under TYPE_CHECKING too."""
    paths = {".".join(path.relative_to(package.parent).with_suffix("").parts): path for path in package.rglob("*.py")}
    modules = {name.removesuffix(".__init__"): path for name, path in paths.items()}
    return {name: set(_imports(name, path, modules.keys())) - {name} for name, path in modules.items()}


def _imports(name: str, path: Path, modules: Set[str]) -> Iterator[str]:
    parent = name if path.name == "__init__.py" else name.rpartition(".")[0]
    for node in ast.walk(ast.parse(path.read_bytes())):
        if isinstance(node, ast.Import):
            found = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            origin = resolve_name("." * node.level + (node.module or ""), parent)
            inner = [f"{origin}.{alias.name}" for alias in node.names]
            found = [module if module in modules else origin for module in inner]
        else:
            continue
        yield from (module for module in found if module in modules)


@pytest.mark.parametrize("package", ["msdgs_serve", "msdgs_train", "msdgs_export"])
def test_no_imports_go_in_circles(package: str) -> None:
    graph = import_graph(ROOT / package)
    assert sum(map(len, graph.values())) > len(graph)
    TopologicalSorter(graph).prepare()


@pytest.mark.parametrize(
    "back",
    [
        "import package.a",
        "from package import a",
        "from . import a",
        "from .a import thing",
        "def f():\n    from package.a import thing",
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from package.a import thing",
    ],
)
def test_a_circle_is_found(back: str, tmp_path: Path) -> None:
    files = {"__init__": "", "a": "from package.b import thing", "b": "from package.c import thing", "c": back}
    for name, text in files.items():
        path = tmp_path / "package" / f"{name}.py"
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
    with pytest.raises(CycleError):
        TopologicalSorter(import_graph(tmp_path / "package")).prepare()


@pytest.mark.parametrize(
    ("code", "needed", "unwanted"),
    [
        ("import msdgs_serve", "msdgs_serve", HEAVY),
        # httpx, which the client needs, loads rich if it is installed
        (IMPORT_ALL.format(skip="msdgs_serve.client"), "fastapi", NOT_FOR_SERVING),
        (IMPORT_ALL.format(skip="msdgs_serve.api"), "numba", HTTP),
        ("import sys; sys.path.insert(0, 'examples'); import demo", "serving", HEAVY | HTTP | NOT_FOR_SERVING),
    ],
    ids=["package", "service", "service without its API", "serving demo"],
)
def test_imports_load_nothing_that_they_do_not_need(code: str, needed: str, unwanted: set[str]) -> None:
    loaded = modules_after(code)
    assert needed in loaded
    assert not loaded & unwanted

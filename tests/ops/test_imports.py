"""Which package may import which: checked in the sources by import-linter, and in fresh interpreters."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.processes import ROOT, run_python

pytestmark = pytest.mark.slow

HEAVY = {"numpy", "numba", "onnxruntime", "OpenImageIO", "fastapi", "pydantic", "torch"}
HTTP = {"fastapi", "starlette", "uvicorn", "pydantic", "pydantic_settings"}
NOT_FOR_SERVING = {"torch", "onnx", "msdgs_train", "export", "matplotlib", "tyro", "rich", "zstandard"}

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

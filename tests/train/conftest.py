"""Shared settings of the tests of training."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from msdgs_serve.threads import THREADS_VARIABLE
from msdgs_train.comparison import pools
from msdgs_train.engine import run as run_module
from tests.support.training_scene import write_scene


@pytest.fixture(scope="session")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a tiny scene; it is only read."""
    return write_scene(tmp_path_factory.mktemp("data") / "scene")


@pytest.fixture
def no_curve(monkeypatch: pytest.MonkeyPatch) -> None:
    """Skip plots, which take longer than the rest of a tiny run."""
    monkeypatch.setattr(run_module, "draw_curve", lambda run: None)


@pytest.fixture
def in_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    """Train the runs of comparisons in threads of this process, which need no start of Python and torch."""
    monkeypatch.setenv(THREADS_VARIABLE, "1")  # as a run sets it, and undone
    monkeypatch.setattr(pools, "ProcessPoolExecutor", lambda jobs, *_: ThreadPoolExecutor(jobs))

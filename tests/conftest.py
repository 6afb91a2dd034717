"""Shared settings of the tests."""

import logging
import os
from collections.abc import Iterator
from pathlib import Path

# the pool has two threads wherever the tests run, so that parallel code is tested as parallel code
os.environ.setdefault("MSDGS_THREADS", "2")

import hypothesis
import numpy as np
import pytest

from tests.support.fuzzing import CASES, IS_FRESH
from tests.support.scene_files import write_scene
from tests.support.skips import not_tested, unexpected

hypothesis.settings.register_profile(
    "any machine",
    max_examples=CASES,
    derandomize=not IS_FRESH,
    database=None,
    deadline=None,
    suppress_health_check=[hypothesis.HealthCheck.too_slow],
)
hypothesis.settings.load_profile("any machine")


@pytest.fixture(autouse=True)
def tiny_numbers_stay():
    """A process that flushes denormals would change the results of all later tests on this worker."""
    yield
    assert np.float32(1e-38) * np.float32(1e-2) > 0


@pytest.fixture(autouse=True)
def no_log_handler_stays():
    """What `msdgs_serve.api.cli.main` sets up would write logs of later tests to a stream that is closed by then."""
    level = logging.root.level
    yield
    for handler in [found for found in logging.root.handlers if type(found) is logging.StreamHandler]:
        logging.root.removeHandler(handler)
    logging.root.setLevel(level)


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene file of two balls, one of which moves; read-only."""
    return write_scene(tmp_path_factory.mktemp("scenes") / "balls.onnx")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """An empty folder for scenes."""
    (tmp_path / "scenes").mkdir()
    return tmp_path / "scenes"


@pytest.fixture
def file(tmp_path: Path) -> bytes:
    """The contents of a scene file."""
    return write_scene(tmp_path / "scene.onnx").read_bytes()


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_sessionfinish(session: pytest.Session) -> Iterator[None]:
    """Report skipped tests at the end. In CI a skip that isn't in `ALLOWED_SKIPS` is a failure."""
    yield
    terminal = session.config.pluginmanager.get_plugin("terminalreporter")
    if terminal is None or hasattr(session.config, "workerinput"):
        return
    reports = terminal.stats.get("skipped", [])
    reasons = [report.longrepr[2].removeprefix("Skipped: ") for report in reports]
    unlisted = unexpected(reasons)
    if unlisted and (os.environ.get("CI") or os.environ.get("MSDGS_CI")):
        terminal.write_line(f"FAILED: skipped, and not on the list in tests/support/skips.py: {unlisted}", red=True)
        session.exitstatus = session.exitstatus or pytest.ExitCode.TESTS_FAILED
    elif line := not_tested(reasons):
        terminal.write_line(line, yellow=True)

"""The live view in a browser: a run is viewed, paused, stopped, and viewed after its end."""

import contextlib
import re
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser, Page

from msdgs_train.cli import main as cli
from msdgs_train.datasets import load_scene
from msdgs_train.viewer.scene_view import view_of_data
from msdgs_train.viewer.snapshot import Snapshot
from msdgs_train.viewer.viewer import Viewer
from tests.support.images import decode
from tests.support.models import random_model
from tests.support.processes import WEBGL, chromium, program, wait_for
from tests.support.tolerances import assert_close
from tests.support.training_scene import FEW

pytest.importorskip("viser", reason="viser isn't installed: `make test-viewer`, or pip install 'msdgs[viewer]'")
pytestmark = pytest.mark.slow

OPTIONS = [*FEW, "--layers", *["mlp:width=16,depth=2"] * 2, "--viewer", "--viewer-port=0"]
MILLISECONDS = 60_000


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium(*WEBGL) as browser:
        yield browser


@pytest.fixture
def page(browser: Browser) -> Iterator[Page]:
    with browser.new_context(viewport={"width": 640, "height": 400}) as context:
        page = context.new_page()
        page.set_default_timeout(MILLISECONDS)
        yield page


def _address(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    return next(said[0] for line in process.stdout if (said := re.search(r"http://localhost:\d+", line)))


def _shown(page: Page) -> np.ndarray:
    """The left half of the page, [H, W, 3]: controls are at the right, messages at the top."""
    return decode(page.screenshot(), "png")[0][100:, :320, :3]


def _step(page: Page) -> int:
    text = page.locator("strong", has_text="step").inner_text()
    return int(re.sub(r"\D", "", text))


def test_a_run_is_seen_paused_and_stopped(data: Path, tmp_path: Path, page: Page) -> None:
    with program("msdgs_train", "fit", data, tmp_path / "run", "--steps=1000000", *OPTIONS) as process:
        page.goto(_address(process))
        page.locator("strong", has_text="step").wait_for()
        wait_for(lambda: len(np.unique(_shown(page).reshape(-1, 3), axis=0)) > 50)
        before = _step(page)
        wait_for(lambda: _step(page) > before)
        page.get_by_label("pause").check(force=True)
        page.wait_for_timeout(1500)
        paused = _step(page)
        page.wait_for_timeout(1500)
        assert _step(page) == paused
        process.send_signal(signal.SIGINT)
        output = process.communicate(timeout=600)[0]
    assert process.returncode == cli.EXIT_INTERRUPTED, output
    assert "interrupted at step" in output
    assert (tmp_path / "run" / "checkpoint.pt").exists()


def test_the_page_stays_until_ctrl_c(data: Path, tmp_path: Path, page: Page) -> None:
    with program("msdgs_train", "fit", data, tmp_path / "run", "--steps=3", *OPTIONS) as process:
        page.goto(_address(process))
        wait_for(lambda: len(np.unique(_shown(page).reshape(-1, 3), axis=0)) > 50)
        assert process.stdout is not None
        assert any("Ctrl-C ends it" in line for line in process.stdout)
        assert process.poll() is None
        process.send_signal(signal.SIGINT)
        assert process.wait(600) == 0


@pytest.mark.parametrize("opened_early", [True, False])
def test_a_browsers_camera_begins_at_the_first_image(data: Path, page: Page, opened_early: bool) -> None:
    scene = load_scene(data)
    model, stage = random_model(), view_of_data(scene, 2)
    with Viewer("127.0.0.1", 0) as viewer:
        if opened_early:
            page.goto(viewer.url)
            wait_for(viewer.server.get_clients)
        viewer.open(stage)
        viewer.show(Snapshot(model, (1.0, 1.0, 1.0)))
        if not opened_early:
            page.goto(viewer.url)
        wait_for(lambda: _camera(viewer) is not None)
        with contextlib.suppress(AssertionError):  # a page starts with viser's camera
            wait_for(lambda: np.allclose(_camera(viewer).position, stage.eye, atol=0.1), seconds=20)
        camera = _camera(viewer)
    assert_close(camera.camera_to_world, scene.splits["train"][0].camera.camera_to_world, "browser_camera")
    assert (camera.width, camera.height) == (640, 400)
    assert_close(2 * np.arctan(camera.height / (2 * camera.fy)), stage.fov_y, "browser_camera")


def _camera(viewer: Viewer) -> Any:
    """The camera that the only browser requests; None before the first request."""
    wanted = [browser.wanted for browser in viewer._browsers.values()]
    return wanted[0].camera(1.0) if wanted and wanted[0] else None

"""Other programs: Python code in a process of its own, free ports, and a headless Chromium if this machine has one."""

import base64
import contextlib
import json
import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser, Page, Request, sync_playwright

from tests.support.images import decode

ROOT = Path(__file__).parents[2]

HOLD_FRAMES = """() => {
    const send = window.fetch;
    const released = new Promise((resolve) => { window.release = resolve; });
    window.waiting = 0;
    window.mostWaiting = 0;
    window.fetch = async (address, options) => {
        if (address !== "render") return send(address, options);
        window.waiting += 1;
        window.mostWaiting = Math.max(window.mostWaiting, window.waiting);
        const aborted = new Promise((_, fail) => {
            options.signal.addEventListener("abort", () => fail(options.signal.reason));
        });
        try {
            await Promise.race([released, aborted]);
            return await send(address, options);
        } finally {
            window.waiting -= 1;
        }
    };
}"""
"""Holds the requests for frames until `release()`; counts those that have no response yet, and the most at one time."""


def run_python(code: str, *arguments: object, **environment: str) -> str:
    """Run code in another process and return its output; `environment` is added to the variables of this process."""
    command = [sys.executable, "-c", code, *map(str, arguments)]
    done = subprocess.run(
        command, cwd=ROOT, env={**os.environ, **environment}, capture_output=True, text=True, timeout=600, check=False
    )
    assert done.returncode == 0, done.stdout[-5000:] + done.stderr
    return done.stdout


@contextlib.contextmanager
def program(module: str, *arguments: object) -> Iterator[subprocess.Popen[str]]:
    """Yield a module that runs in another process, which doesn't outlive the block; errors are in its output."""
    with subprocess.Popen(
        [sys.executable, "-m", module, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"},
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def wait_for(holds: Callable[[], object], seconds: float = 60.0) -> None:
    """Wait until a condition holds; fail after some seconds."""
    deadline = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.005)


def free_port() -> int:
    """Return a port of this machine on which nothing listens."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")


def find_chromium() -> str | None:
    """Return the path of Chromium: `MSDGS_CHROMIUM`, or one on `PATH`."""
    return os.environ.get("MSDGS_CHROMIUM") or next(filter(None, map(shutil.which, NAMES)), None)


WEBGL = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")
"""Options for pages that need WebGL; it is rendered on the CPU."""


@contextlib.contextmanager
def chromium(*arguments: str) -> Iterator[Browser]:
    """Yield a headless Chromium; skip the test if there is none."""
    program = find_chromium()
    if program is None:
        pytest.skip("no Chromium on this machine; `apt-get install chromium libatomic1`, or name one in MSDGS_CHROMIUM")
    with sync_playwright() as playwright:
        # it runs as root in containers, and opens only our own page
        browser = playwright.chromium.launch(
            executable_path=program, args=["--no-sandbox", "--disable-gpu", *arguments]
        )
        yield browser
        browser.close()


def forget(page: Page) -> None:
    """Reset the page's mark of a shown frame, for which `wait_until_still` waits."""
    page.evaluate("document.getElementById('image').dataset.shown = ''")


def wait_until_still(page: Page) -> None:
    """Wait until a frame in full quality is shown."""
    page.wait_for_selector("#image[data-shown=full]")


def image(page: Page) -> np.ndarray:
    """Return the pixels of the page's canvas, [H, W, 3] from 0 to 255."""
    address = page.evaluate("document.getElementById('image').toDataURL('image/png')")
    return decode(base64.b64decode(address.split(",")[1]), "png")[0][..., :3]


def bodies(page: Page) -> list[dict[str, Any]]:
    """Return a list that each later request for a frame adds its body to."""
    asked: list[dict[str, Any]] = []

    def note(request: Request) -> None:
        if request.method == "POST" and request.url.endswith("/render"):
            asked.append(json.loads(request.post_data or ""))

    page.on("request", note)
    return asked

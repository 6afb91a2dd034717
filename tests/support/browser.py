"""A headless Chromium for the page, if this machine has one."""

import contextlib
import os
import shutil
from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, Page, sync_playwright

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")


def find_chromium() -> str | None:
    """`MSDGS_CHROMIUM`, or what is on the path."""
    return os.environ.get("MSDGS_CHROMIUM") or next(filter(None, map(shutil.which, NAMES)), None)


WEBGL = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")
"""Drawn by the processor: for pages that show nothing without WebGL."""


@contextlib.contextmanager
def chromium(*arguments: str) -> Iterator[Browser]:
    """Ended on leaving. Skips the test that asks where there is none."""
    program = find_chromium()
    if program is None:
        pytest.skip("no Chromium on this machine; `apt-get install chromium`, or name one in MSDGS_CHROMIUM")
    with sync_playwright() as playwright:
        # it runs as root in containers, and shows nothing but our own page
        browser = playwright.chromium.launch(
            executable_path=program, args=["--no-sandbox", "--disable-gpu", *arguments]
        )
        yield browser
        browser.close()


def forget(page: Page) -> None:
    """That a frame was shown: what `wait_until_still` waits for comes after this."""
    page.evaluate("document.getElementById('image').dataset.shown = ''")


def wait_until_still(page: Page) -> None:
    """Until a frame in full quality is shown."""
    page.wait_for_selector("#image[data-shown=full]")

"""A browser for the tests of the page at /."""

from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from playwright.sync_api import Browser, Page, expect

from tests.support.processes import chromium, wait_until_still
from tests.support.service import serving

MILLISECONDS = 60_000
"""Maximum wait for something on a page."""
expect.set_options(timeout=MILLISECONDS)


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as browser:
        yield browser


@pytest.fixture(scope="module")
def modules(browser: Browser, scene: Path) -> Iterator[Page]:
    """A page whose modules can be imported by scripts."""
    with serving(scene) as client, browser.new_context() as context:
        page = context.new_page()
        page.goto(f"{client.base_url}/viewer/icon.svg")
        yield page


@pytest.fixture
def page(browser: Browser) -> Iterator[Page]:
    """Yield an empty page; fail if its console shows an error other than a request that found no service."""
    with browser.new_context(viewport={"width": 820, "height": 420}, reduced_motion="reduce") as context:
        page = context.new_page()
        page.set_default_timeout(MILLISECONDS)
        complaints: list[str] = []
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("console", lambda line: complaints.append(line.text) if line.type in ("error", "warning") else None)
        yield page
        assert [text for text in complaints if not text.startswith("Failed to load resource")] == []


def open_page(page: Page, client: httpx.Client, address: str = "#scene=balls") -> Page:
    """Open the page of a service, and wait for its first frame in full quality."""
    page.goto(f"{client.base_url}/{address}")
    wait_until_still(page)
    return page

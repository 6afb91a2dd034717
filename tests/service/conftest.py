"""A browser for the tests of the page at /."""

from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from playwright.sync_api import Browser, Page, expect

from tests.support.pages import MILLISECONDS, watched_page
from tests.support.processes import chromium, wait_until_still
from tests.support.service import serving

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
    """An empty page; fails if its console shows an error other than a request that found no service."""
    with watched_page(browser, reduced_motion="reduce") as page:
        yield page


def open_page(page: Page, client: httpx.Client, address: str = "#scene=balls") -> Page:
    """Open the page of a service, and wait for its first frame in full quality."""
    page.goto(f"{client.base_url}/{address}")
    wait_until_still(page)
    return page

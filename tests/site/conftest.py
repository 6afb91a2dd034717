"""A browser with WebGL, and sites on a plain file server."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect

from tests.support.pages import MILLISECONDS, watched_page
from tests.support.processes import WEBGL, chromium
from tests.support.sites import RUNTIME, file_server, write_site

expect.set_options(timeout=MILLISECONDS)


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium(*WEBGL) as browser:
        yield browser


@pytest.fixture
def page(browser: Browser) -> Iterator[Page]:
    """An empty page; fails if its console shows an error other than a file that isn't there."""
    with watched_page(browser) as page:
        yield page


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of sites below the server's own."""
    folder = tmp_path_factory.mktemp("sites") / "a path"
    folder.mkdir()
    return folder


@pytest.fixture(scope="session")
def site(folder: Path, scene: Path) -> Path:
    """The site of two balls, one of which moves; read-only."""
    return write_site(scene, folder / "site", RUNTIME, title="Balls")


@pytest.fixture(scope="session")
def server(folder: Path) -> Iterator[str]:
    """The address of `folder`, without a slash at its end."""
    with file_server(folder.parent) as address:
        yield f"{address}/a%20path"

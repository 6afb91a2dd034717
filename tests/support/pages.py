"""Pages in a browser whose consoles are watched."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from playwright.sync_api import Browser, Page

MILLISECONDS = 60_000
"""Maximum wait for something on a page."""
HARMLESS = ("Failed to load resource", "[.WebGL-")
"""Beginnings of lines of a console: a request without an answer, and remarks of the driver on its own speed."""


@contextmanager
def watched_page(browser: Browser, **options: Any) -> Iterator[Page]:
    """An empty page; fails at the end if its console has shown an error or a warning that isn't `HARMLESS`."""
    with browser.new_context(**{"viewport": {"width": 820, "height": 420}, **options}) as context:
        page = context.new_page()
        page.set_default_timeout(MILLISECONDS)
        complaints: list[str] = []
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("console", lambda line: complaints.append(line.text) if line.type in ("error", "warning") else None)
        yield page
        assert [text for text in complaints if not text.startswith(HARMLESS)] == []

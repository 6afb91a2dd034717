"""Links of the docs are valid, every image and table is used, and the pages are short."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PAGES = [*sorted(DOCS.glob("*.md")), *sorted(ROOT.glob("*.md"))]
MAX_WORDS = 14_000  # of docs/*.md together


def targets(page: Path) -> set[Path]:
    """Files of the checkout that a page links to."""
    links = re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8"))
    return {(page.parent / link).resolve() for link in links if "://" not in link}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_to_files(page: Path):
    assert [path for path in targets(page) if not path.exists()] == []


def test_every_image_and_table_is_linked():
    linked = set[Path]().union(*map(targets, PAGES))
    kept = {path.resolve() for folder in ("images", "data") for path in (DOCS / folder).iterdir()}
    assert kept - linked == set()


def test_the_docs_are_short():
    assert sum(len(page.read_text(encoding="utf-8").split()) for page in DOCS.glob("*.md")) <= MAX_WORDS

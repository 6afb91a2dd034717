"""Links of the docs are valid, and every image and table is used."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PAGES = [*sorted(DOCS.glob("*.md")), *sorted(ROOT.glob("*.md"))]


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

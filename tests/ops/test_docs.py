"""Links of the docs are valid, every image and table is used, and commands and code do what the pages say."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.support.service import serving

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


def test_ci_runs_the_make_commands_of_the_readme():
    commands = re.findall(r"^make ([a-z-]+)", (ROOT / "README.md").read_text(encoding="utf-8"), re.MULTILINE)
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    run = re.findall(r"^(?:\w+=\S+ )?make (.+)", (ROOT / ".ci" / "run").read_text(encoding="utf-8"), re.MULTILINE)
    assert {"demo", "test"} <= set(commands)
    for command in commands:
        assert f"\n{command}:" in makefile
        assert any(command in line.split() for line in run), f".ci/run doesn't run `make {command}`"


@pytest.mark.slow
def test_the_code_of_python_md_runs(monkeypatch: pytest.MonkeyPatch):
    """All blocks in order, in one namespace, as a reader types them."""
    monkeypatch.chdir(ROOT)
    page = (DOCS / "python.md").read_text(encoding="utf-8")
    first, path, motion, service = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    names: dict[str, Any] = {}
    exec(first, names)
    height, width = names["first"].camera.height, names["first"].camera.width
    assert (names["frame"].rgb.shape, names["frame"].rgb.dtype) == ((height, width, 3), np.float32)
    assert names["frame"].alpha.shape == (height, width)
    assert names["frame"].rgb.std() > 0.1, "an empty frame"

    exec(path, names)
    assert names["video"].shape == (8, 240, 320, 3)
    assert all(frame.std() > 10 for frame in names["video"]), "an empty frame"

    exec(motion, names)
    frame = names["frame"]
    assert frame.depth.shape == frame.alpha.shape == (240, 320)
    assert np.isinf(frame.depth[frame.alpha == 0]).all()
    assert np.abs(frame.motion).max() > 0.1
    assert (frame.rgb[frame.alpha == 0] == 0).all()

    with serving(ROOT / "examples" / "toys.onnx") as running:
        exec(service.replace("http://localhost:8000", str(running.base_url)), names)
    assert names["frame"].rgb.shape == (400, 400, 3)
    assert names["flow"].motion.shape == (400, 400, 2)
    assert names["image"][:4] == b"\x76\x2f\x31\x01", "not an EXR file"
    assert names["name"] == "toys"

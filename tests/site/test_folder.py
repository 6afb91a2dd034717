"""The folder that `msdgs-convert --site` writes: its files, its page, and what is refused."""

import errno
import gzip
import json
import os
import re
from html.parser import HTMLParser
from io import StringIO
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from msdgs_export.exporters.command import convert
from msdgs_export.exporters.site.page import POLICY, folder_url
from msdgs_export.exporters.site.runtime import VERSION, RuntimeMissing, cache_folder
from msdgs_export.options import ConvertOptions
from msdgs_serve.browser import RUNTIME_FILES
from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.writing import WriteFailed
from tests.support.images import decode
from tests.support.processes import ROOT
from tests.support.sites import stand_in, write_site

*_, WASM = RUNTIME_FILES
SCRIPT_BYTES = 80_000
"""Of our own scripts, compressed."""


class Page(HTMLParser):
    """The elements of a page with their attributes and texts, as a browser reads them."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.texts: dict[str, str] = {}
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        if self.elements:
            self.texts.setdefault(self.elements[-1][0], data)

    def meta(self) -> dict[str, str | None]:
        """The contents of `meta` elements by name or property."""
        metas = [attributes for tag, attributes in self.elements if tag == "meta"]
        return {
            key: each.get("content")
            for each in metas
            if (key := each.get("name") or each.get("property") or each.get("http-equiv"))
        }


@pytest.fixture
def runtime(tmp_path: Path) -> Path:
    return stand_in(tmp_path / "onnxruntime-web")


@pytest.fixture
def site(tmp_path: Path, scene: Path, runtime: Path) -> Path:
    return write_site(scene, tmp_path / "a" / "new" / "site", runtime)


def page_of(site: Path) -> Page:
    return Page((site / "index.html").read_text(encoding="utf-8"))


def test_it_holds_all_that_the_page_needs_and_the_licenses(site: Path, scene: Path):
    assert not list(site.glob(".msdgs-*"))
    description = json.loads((site / "scene.json").read_text())
    files = {path.relative_to(site).as_posix() for path in site.rglob("*") if path.is_file()}
    assert set(description["files"]) == files
    assert {"LICENSE.txt", "onnxruntime-web/LICENSE.txt", "onnxruntime-web/ThirdPartyNotices.txt"} <= files
    assert (site / "LICENSE.txt").read_text() == (ROOT / "LICENSE").read_text()
    assert {f"onnxruntime-web/{name}" for name in RUNTIME_FILES.values()} <= files
    assert not any(path.startswith("viewer/service") for path in files)
    named = [value for _, each in page_of(site).elements for key in ("src", "href") if (value := each.get(key))]
    assert len(named) > 4
    assert set(named) <= files
    imported = re.compile(r'(?:from |import\(|new URL\(|worker\()"(\.{0,2}/?[\w./]+\.js)"')
    for path in (each for each in files if each.endswith(".js")):
        for target in imported.findall((site / path).read_text()):
            assert (site / path).parent.joinpath(target).is_file(), f"{path} imports {target}"


@pytest.mark.parametrize(("saved", "name"), [(0.1, "scene.onnx.gz"), (1.0, "scene.onnx")])
def test_the_scene_is_the_very_file_compressed_if_that_saves_bytes(
    tmp_path: Path, scene: Path, runtime: Path, monkeypatch: pytest.MonkeyPatch, saved: float, name: str
):
    monkeypatch.setattr("msdgs_export.exporters.site.folder.MIN_SAVED", saved)
    site = write_site(scene, tmp_path / "site", runtime)
    stored = json.loads((site / "scene.json").read_text())["file"]
    contents = (site / name).read_bytes()
    assert stored == {"path": name, "size": scene.stat().st_size, "stored": len(contents)}
    assert (gzip.decompress(contents) if name.endswith(".gz") else contents) == scene.read_bytes()


def test_the_wasm_is_compressed_once(tmp_path: Path, scene: Path, runtime: Path):
    contents = b"\0asm" * 1000
    for number, stored in enumerate((contents, gzip.compress(contents))):
        (runtime / WASM).write_bytes(stored)
        site = write_site(scene, tmp_path / str(number), runtime)
        assert gzip.decompress((site / "onnxruntime-web" / RUNTIME_FILES[WASM]).read_bytes()) == contents


def test_servers_know_the_types_of_its_scripts(site: Path):
    assert not list(site.rglob("*.mjs")), "nginx sends them as a type that browsers refuse"


def test_the_preview_shows_the_scene_as_links_show_pictures(site: Path):
    pixels, _ = decode((site / "preview.jpg").read_bytes(), "jpeg")
    assert pixels.shape == (630, 1200, 3)
    assert pixels[315, 600, 0] > 150, "the red ball"
    assert pixels[10, 10].argmax() == 2, "the blue background"


def test_our_scripts_are_small_and_name_no_other_host(site: Path):
    own = [path for path in site.rglob("*") if path.suffix in (".js", ".html", ".css", ".svg")]
    assert sum(len(gzip.compress(path.read_bytes())) for path in own) <= SCRIPT_BYTES
    addresses = [re.findall(r"(?:https?|wss?)://[\w.-]+", path.read_text()) for path in own]
    assert {each for found in addresses for each in found} <= {"http://localhost", "http://www.w3.org"}


@pytest.mark.parametrize(
    "text",
    ['</script><script>alert("1")</script>', '"><img src=x onerror=alert(1)>', "it's & <b>Ünï</b> 𝒸 \u202e", "&amp;"],
)
def test_texts_are_text(tmp_path: Path, scene: Path, runtime: Path, text: str):
    plain = Page((write_site(scene, tmp_path / "plain", runtime) / "index.html").read_text(encoding="utf-8"))
    site = write_site(scene, tmp_path / "site", runtime, title=text, description=text, url="https://example.org/a/")
    page = page_of(site)
    assert page.texts["title"] == page.texts["h1"] == text
    assert {page.meta()[name] for name in ("description", "og:title", "og:description")} == {text}
    tags = [tag for tag, _ in page.elements if tag != "meta"]
    assert tags == [tag for tag, _ in plain.elements if tag != "meta"]


def test_names_of_files_are_text(tmp_path: Path, scene: Path, runtime: Path):
    for stem in ("</title><b>", "caf\u00e9", b"\xff".decode("utf-8", "surrogateescape")):
        named = tmp_path / f"{stem}.onnx".replace("/", "\u2215")
        named.write_bytes(scene.read_bytes())
        page = page_of(write_site(named, tmp_path / "site", runtime))
        assert page.texts["title"] == named.stem.encode("utf-8", "replace").decode()


def test_it_offers_and_explains_only_what_browsers_draw(site: Path):
    offered = [attributes["value"] for _, attributes in page_of(site).elements if attributes.get("name") == "view"]
    (drawn,) = re.findall(r"CHANNELS = (\[.*\]);", (site / "viewer" / "local" / "graphics.js").read_text())
    assert offered == ["rgb", "depth"]
    assert set(offered) <= set(json.loads(drawn))
    text = (site / "index.html").read_text()
    assert re.findall(r"<kbd>(\d)</kbd>", text) == ["1", "2"]
    assert "motion" not in text.lower()


def test_without_scripts_it_says_that_it_needs_them(site: Path):
    assert page_of(site).texts["noscript"] == "This page needs JavaScript."


def test_titles_are_one_line(tmp_path: Path, scene: Path, runtime: Path):
    for title, shown in (("a\nb\t c\n", "a b c"), (" ", scene.stem), ("a\udcff", "a?")):
        assert page_of(write_site(scene, tmp_path / "site", runtime, title=title)).texts["title"] == shown


def test_the_policy_admits_only_the_folder(site: Path):
    tag, attributes = page_of(site).elements[3]
    assert (tag, attributes["content"]) == ("meta", POLICY), "before anything that it concerns"
    sources = {word for part in POLICY.split(";") for word in part.split()[1:]}
    assert sources == {"'none'", "'self'", "'wasm-unsafe-eval'"}


def test_links_to_it_show_a_picture_if_its_address_is_known(tmp_path: Path, scene: Path, runtime: Path, site: Path):
    assert not any(name.startswith(("og:", "twitter:")) for name in page_of(site).meta())
    there = write_site(scene, tmp_path / "there", runtime, url="https://example.org/my toys", title="Toys")
    meta = page_of(there).meta()
    assert meta["og:url"] == "https://example.org/my%20toys/"
    assert meta["og:image"] == "https://example.org/my%20toys/preview.jpg"
    assert (meta["og:title"], meta["twitter:card"]) == ("Toys", "summary_large_image")


@pytest.mark.parametrize(
    ("url", "folder"),
    [
        ("https://example.org", "https://example.org/"),
        ("http://localhost:8000/a/index.html", "http://localhost:8000/a/"),
        ("https://example.org/a%20b/", "https://example.org/a%20b/"),
        ('https://user.github.io/é/"x"', "https://user.github.io/%C3%A9/%22x%22/"),
        ("http://[::1]:80", "http://[::1]:80/"),
        ("https://example.org/\udcff", "https://example.org/%FF/"),
    ],
)
def test_addresses_are_those_of_the_folder(url: str, folder: str):
    assert folder_url(url) == folder


@pytest.mark.parametrize(
    "url",
    [
        "example.org/a",
        "ftp://example.org",
        "javascript:alert(1)",
        "https://",
        "/a",
        "",
        "https://a/?b",
        "https://a b/",
        'https://a"/',
        "https://[::1 /",
        "https://a\udcff/",
    ],
)
def test_other_addresses_are_refused(tmp_path: Path, scene: Path, runtime: Path, url: str):
    with pytest.raises(InvalidInput, match=r"`?url`?"):
        write_site(scene, tmp_path / "site", runtime, url=url)
    assert not (tmp_path / "site").exists()


def test_it_replaces_a_site_and_nothing_else(tmp_path: Path, scene: Path, runtime: Path, site: Path):
    (site / "preview.jpg").unlink()
    write_site(scene, site, runtime, title="Again")
    assert page_of(site).texts["title"] == "Again"
    assert (site / "preview.jpg").is_file()
    (site / "CNAME").write_text("example.org")
    with pytest.raises(InvalidInput, match="CNAME"):
        write_site(scene, site, runtime)
    assert (site / "CNAME").read_text() == "example.org"

    (tmp_path / "empty").mkdir()
    assert (write_site(scene, tmp_path / "empty", runtime) / "index.html").is_file()
    other = tmp_path / "other"
    other.mkdir()
    (other / "scene.json").write_text("[]")
    with pytest.raises(InvalidInput, match=r"holds scene\.json"):
        write_site(scene, other, runtime)
    (tmp_path / "file").write_text("text")
    with pytest.raises(InvalidInput, match="a folder"):
        write_site(scene, tmp_path / "file", runtime)


def test_the_folder_itself_stays(scene: Path, runtime: Path, site: Path, monkeypatch: pytest.MonkeyPatch):
    replace = os.replace

    def mounted(source: Path, target: Path) -> None:
        if site in (source, target):
            raise OSError(errno.EBUSY, os.strerror(errno.EBUSY), str(source))
        replace(source, target)

    monkeypatch.setattr(os, "replace", mounted)
    (site / "lost+found").mkdir()
    (site / ".msdgs-killed").mkdir()
    (site / ".msdgs-killed" / "index.html").write_text("")
    (site / "viewer" / "old.js").write_text("")
    description = json.loads((site / "scene.json").read_text())
    (site / "scene.json").write_text(json.dumps(description | {"files": [*description["files"], "viewer/old.js"]}))
    monkeypatch.chdir(site)
    told = StringIO()
    write_site(scene, Path(), runtime, Console(file=told, soft_wrap=True), title="Again")
    assert f'src="{site.name}/"' in told.getvalue()
    assert page_of(site).texts["title"] == "Again"
    assert not (site / "viewer" / "old.js").exists()
    assert (site / "lost+found").is_dir()


def test_an_interrupted_one_leaves_the_old_one(scene: Path, runtime: Path, site: Path, monkeypatch: pytest.MonkeyPatch):
    old = page_of(site).texts["title"]
    write = Path.write_bytes

    def failing(path: Path, contents: bytes) -> int:
        if path.name == "scene.onnx.gz":
            raise OSError(28, "No space left on device", str(path))
        return write(path, contents)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", failing)
        with pytest.raises(WriteFailed, match="the disk is full"):
            write_site(scene, site, runtime, title="New")
        with pytest.raises(WriteFailed, match="the disk is full"):
            write_site(scene, site.parent / "new", runtime)
    assert page_of(site).texts["title"] == old
    assert not list(site.glob(".msdgs-*"))
    assert not (site.parent / "new").exists()


def contents_of(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("count", [1, 4, 7, 10, 13])
def test_one_that_cannot_take_its_place_leaves_the_old_one(
    scene: Path, runtime: Path, site: Path, monkeypatch: pytest.MonkeyPatch, count: int
):
    before, replace, moved = contents_of(site), os.replace, []

    def failing(source: Path, target: Path) -> None:
        moved.append(source)
        if len(moved) == count:
            raise KeyboardInterrupt
        replace(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", failing)
        with pytest.raises(KeyboardInterrupt):
            write_site(scene, site, runtime, title="New")
    assert contents_of(site) == before


def test_it_tells_the_address_of_folders_whose_names_are_no_text(tmp_path: Path, scene: Path, runtime: Path):
    told = StringIO()
    write_site(scene, tmp_path / "a\udcff", runtime, Console(file=told, soft_wrap=True))
    assert 'src="a%FF/"' in told.getvalue()


def test_it_tells_how_to_look_at_it(tmp_path: Path, scene: Path, runtime: Path):
    out, told = tmp_path / "my site", StringIO()
    write_site(scene, out, runtime, Console(file=told, soft_wrap=True), title='a "b"')
    assert f"python -m http.server -d '{out}'" in told.getvalue()
    (line,) = [line for line in told.getvalue().splitlines() if "<iframe" in line]
    ((tag, attributes),) = Page(line).elements
    assert (tag, attributes["src"], attributes["title"]) == ("iframe", "my%20site/", 'a "b"')


@pytest.mark.parametrize(
    "option", [{"title": "a"}, {"description": "a"}, {"url": "https://a.b"}, {"onnxruntime_web": Path()}]
)
def test_its_options_are_for_sites_only(tmp_path: Path, scene: Path, option: dict[str, Any]):
    (name,) = option
    with pytest.raises(InvalidInput, match=name):
        convert(ConvertOptions(scene, tmp_path / "a.ply", **option), Console(quiet=True))


@pytest.mark.parametrize("option", [{"t": 0.5}, {"frames": 9}, {"min_psnr": 60.0}])
def test_options_of_other_formats_are_refused(tmp_path: Path, scene: Path, option: dict[str, Any]):
    (name,) = option
    with pytest.raises(InvalidInput, match=f"`{name}` must be left out for a site"):
        convert(ConvertOptions(scene, tmp_path / "site", site=True, **option), Console(quiet=True))


def test_a_folder_without_the_runtime_is_refused(tmp_path: Path, scene: Path, runtime: Path):
    (runtime / WASM).unlink()
    with pytest.raises(InvalidInput, match=f"{WASM} can't be read"):
        write_site(scene, tmp_path / "site", runtime)


NPM = """#!/bin/sh
test "$*" = "ci --ignore-scripts --no-audit --no-fund" && test -f package-lock.json || exit 3
echo called >> "$CALLS"
mkdir -p node_modules/onnxruntime-web/dist && cd node_modules/onnxruntime-web/dist && touch {files}
"""


def test_npm_fetches_the_runtime_once(tmp_path: Path, scene: Path, monkeypatch: pytest.MonkeyPatch):
    npm = tmp_path / "npm"
    npm.write_text(NPM.format(files=" ".join(RUNTIME_FILES)))
    npm.chmod(0o755)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    monkeypatch.setenv("CALLS", str(tmp_path / "calls"))
    for out in ("one", "two"):
        write_site(scene, tmp_path / out, onnxruntime_web=None)
    assert (tmp_path / "calls").read_text() == "called\n"
    assert cache_folder().parent.parent == tmp_path / "cache"


@pytest.mark.parametrize(
    ("npm", "reason"), [(None, "there is no npm"), ("#!/bin/sh\necho no network >&2; exit 1", "no network")]
)
def test_without_npm_it_names_the_command(
    tmp_path: Path, scene: Path, monkeypatch: pytest.MonkeyPatch, npm: str | None, reason: str
):
    if npm is not None:
        (tmp_path / "npm").write_text(npm)
        (tmp_path / "npm").chmod(0o755)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(RuntimeMissing, match=rf"{reason}.*npm install .*onnxruntime-web@{re.escape(VERSION)}"):
        write_site(scene, tmp_path / "site", onnxruntime_web=None)
    assert not (tmp_path / "site").exists()
    assert not cache_folder().exists()


def test_the_fetched_version_has_a_hash():
    lock = json.loads((ROOT / "msdgs_export" / "exporters" / "site" / "package-lock.json").read_text())
    packages = {name: each for name, each in lock["packages"].items() if name}
    assert packages["node_modules/onnxruntime-web"]["version"] == VERSION
    assert all(each["integrity"].startswith("sha512-") for each in packages.values())

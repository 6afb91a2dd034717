"""The service below a path prefix of a proxy: `--root-path` and `X-Forwarded-Prefix`."""

import html
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urljoin

import httpx
import pytest
from playwright.sync_api import Page

from msdgs_serve.api.cli import main
from msdgs_serve.api.prefix import read_prefix
from msdgs_serve.client import Client, Orbit
from tests.service.conftest import open_page
from tests.support.nginx import needs_nginx, nginx
from tests.support.processes import image
from tests.support.scene_files import write_scene
from tests.support.service import FRAME, in_this_process, serving

pytestmark = in_this_process  # on Ray Serve its proxy has the prefix
HEADER = "X-Forwarded-Prefix"
KEY = "0123456789abcdef"
PREFIXES = {
    "/msdgs": "/msdgs",
    "/msdgs/": "/msdgs",
    "/a/b//": "/a/b",
    "": "",
    "/": "",
    "/my scenes": "/my%20scenes",
    "/my%20scenes/": "/my%20scenes",
    "/médias": "/m%C3%A9dias",
    "/m%c3%a9dias": "/m%C3%A9dias",
    "/100%": "/100%25",
    "/a'b<&\"": "/a%27b%3C%26%22",
    "/a,b": "/a%2Cb",
    "/v1.2_x~y-z": "/v1.2_x~y-z",
}
HOSTILE = [
    "//evil.example", "//evil.example/x", "https://evil.example", "evil.example", "msdgs", "/a//b", "/\\evil.example",
    "/%2Fevil.example", "/%5cevil.example", "/a%0d%0aSet-Cookie:x", "/a\tb", "/..", "/a/../b", "/%2e%2e/b", "/./a",
    "/a?b", "/a#b", "/%ff", "/\x7f", "/" + "a" * 300,
]  # fmt: skip


@pytest.fixture(scope="module")
def client(scene: Path) -> Iterator[httpx.Client]:
    with serving(scene) as client:
        yield client


def links(page: httpx.Response) -> list[str]:
    """The addresses that a page of the documentation loads."""
    found = re.findall(r"""(?:href|src|spec-url)="([^"]+)"|(?:"url"|url): ?["']([^"']+)""", page.text)
    return [html.unescape(first or second) for first, second in found]


def check_below(client: httpx.Client, prefix: str, way: str = "", **sent: str) -> None:
    """Check that all addresses that a service names begin with the prefix; it is asked at `way`."""
    for page in ("/docs", "/redoc"):
        names = links(client.get(way + page, headers=sent))
        assert len(names) >= 3
        assert all(name.startswith(f"{prefix}/") and not name.startswith("//") for name in names), names
    servers = client.get(f"{way}/openapi.json", headers=sent).json().get("servers")
    assert servers == ([{"url": prefix}] if prefix else None)
    moved = client.get(f"{way}/scenes/?x=1", headers=sent)
    assert (moved.status_code, moved.headers["Location"]) == (307, f"{prefix}/scenes?x=1")


@pytest.mark.parametrize(("given", "expected"), PREFIXES.items())
def test_prefixes_are_encoded_and_end_without_a_slash(given: str, expected: str):
    assert read_prefix(given) == read_prefix(expected) == expected


@pytest.mark.parametrize("given", HOSTILE)
def test_what_is_no_path_is_refused(given: str, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(ValueError):
        read_prefix(given)
    assert main(["scene.onnx", "--root-path", given]) == 2
    assert "--root-path: must be a path such as /msdgs: from /" in capsys.readouterr().err


@pytest.mark.parametrize("prefix", [each for each in PREFIXES if each.isascii() and "," not in each])
def test_a_trusted_proxy_names_the_prefix(client: httpx.Client, prefix: str):
    check_below(client, PREFIXES[prefix], **{HEADER: prefix})


@pytest.mark.parametrize("prefix", [each for each in HOSTILE if each.isprintable()])
def test_a_hostile_prefix_is_ignored(client: httpx.Client, prefix: str):
    check_below(client, "", **{HEADER: prefix})
    check_below(client, "", **{HEADER: f"/a, {prefix}"})


def test_prefixes_of_several_proxies_are_joined(client: httpx.Client):
    check_below(client, "/outer/inner", **{HEADER: "/outer/, /inner"})
    twice = [(HEADER, "/outer"), (HEADER, "/inner")]
    assert client.get("/scenes/", headers=twice).headers["Location"] == "/outer/inner/scenes"


def test_others_than_trusted_proxies_name_no_prefix(scene: Path):
    with serving(scene, proxies="192.0.2.1") as client:
        check_below(client, "", **{HEADER: "/msdgs", "X-Forwarded-For": "192.0.2.1"})
    with serving(scene, proxies="192.0.2.1", root_path="/own") as client:
        check_below(client, "/own", **{HEADER: "/msdgs"})
    with serving(scene, proxies="127.0.0.0/8", root_path="/own") as client:
        check_below(client, "/msdgs", **{HEADER: "/msdgs", "X-Forwarded-For": "192.0.2.1"})
        check_below(client, "/own", **{HEADER: "//evil.example"})


@pytest.mark.parametrize("prefix", ["/msdgs", "/my%20scenes/x", "/scenes", "/render"])
def test_calls_answer_below_a_prefix(scene: Path, prefix: str):
    with serving(scene, root_path=prefix) as client:
        check_below(client, prefix)
        assert client.post("/render", json=FRAME).status_code == 200
        assert client.get("/scenes/balls").json()["name"] == "balls"
        assert client.get("/").headers["Content-Type"].startswith("text/html")
        assert client.options("/render").headers["Allow"] == "GET, HEAD, POST, OPTIONS"
        if prefix not in ("/scenes", "/render"):  # of a proxy that strips nothing
            check_below(client, prefix, way=prefix)
            assert client.post(f"{prefix}/render", json=FRAME).status_code == 200
            assert client.get(prefix).headers["Location"] == f"{prefix}/"


def test_an_added_scene_is_named_below_the_prefix(folder: Path, file: bytes):
    with serving(folder, uploads=True, root_path="/msdgs") as client:
        for sent, prefix in (({}, "/msdgs"), ({HEADER: "/x/y"}, "/x/y"), ({HEADER: "//evil.example"}, "/msdgs")):
            response = client.post("/scenes?name=a%20b&replace=true", content=file, headers=sent)
            assert response.headers["Location"] == f"{prefix}/scenes/a%20b"
            assert client.get(response.headers["Location"].removeprefix("/x/y")).json()["name"] == "a b"


def test_keys_guard_the_same_paths(scene: Path, tmp_path: Path):
    (tmp_path / "keys").write_text(f"read {KEY}")
    with serving(scene, api_keys_file=tmp_path / "keys", root_path="/live") as client:
        for path in ("/scenes", "/live/scenes", "/live/live/scenes", "/live/../scenes"):
            for sent in ({}, {HEADER: "/scenes"}, {HEADER: "/viewer"}, {HEADER: "/live/live"}):
                assert client.get(path, headers=sent).status_code in (401, 404), path
                assert client.get(path, headers={**sent, "X-API-Key": KEY}).status_code in (200, 404)
        assert client.get("/live").status_code == 200


LOCATIONS = """
location /stripped/ {{ proxy_pass {url}/; proxy_set_header Host $host; proxy_set_header X-Forwarded-Prefix /stripped; }}
location "/my scenes/" {{ proxy_pass {url}/; proxy_set_header X-Forwarded-Prefix "/my scenes/"; }}
location /whole/ {{ proxy_pass {url}; proxy_set_header X-Forwarded-Prefix /whole; }}
location /own/ {{ proxy_pass {own}/; }}
"""


@pytest.fixture(scope="module")
def proxy(tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    folder, scenes = tmp_path_factory.mktemp("nginx"), tmp_path_factory.mktemp("scenes")
    write_scene(scenes / "balls.onnx")
    settings: dict[str, Any] = {"uploads": True}
    with serving(scenes, **settings) as plain, serving(scenes, root_path="/own", **settings) as own:
        urls = {"url": str(plain.base_url).rstrip("/"), "own": str(own.base_url).rstrip("/")}
        with nginx(folder, LOCATIONS.format(**urls)) as client:
            yield client


@needs_nginx
@pytest.mark.parametrize("prefix", ["/stripped", "/my%20scenes", "/whole", "/own"])
def test_behind_nginx_every_address_leads_to_the_service(proxy: httpx.Client, prefix: str, tmp_path: Path):
    check_below(proxy, prefix, way=prefix)
    for page in ("/docs", "/redoc"):
        for link in links(proxy.get(prefix + page)):
            assert proxy.get(link).status_code == 200, link
    moved = proxy.get(f"{prefix}/scenes/", follow_redirects=True)
    assert [each["name"] for each in moved.json()["scenes"]] == ["balls"]
    with Client(f"{proxy.base_url}{prefix}") as client:
        frame = client.render(Orbit(0, 0), 0.5, width=8, height=6)
        assert frame.alpha is not None
        assert frame.alpha.shape == (6, 8)
    added = proxy.post(f"{prefix}/scenes?name=new", content=write_scene(tmp_path / "new.onnx").read_bytes())
    new = urljoin(str(added.request.url), added.headers["Location"])
    assert proxy.get(new).json()["name"] == "new"
    assert proxy.delete(new).status_code == 204


@needs_nginx
@pytest.mark.slow
@pytest.mark.parametrize("prefix", ["/stripped", "/my%20scenes"])
def test_behind_nginx_a_browser_shows_the_page_and_the_documentation(proxy: httpx.Client, page: Page, prefix: str):
    proxy_at = httpx.Client(base_url=f"{proxy.base_url}{prefix}")
    open_page(page, proxy_at)
    assert image(page).std() > 1
    page.goto(f"{proxy.base_url}{prefix}/docs")
    page.click("#operations-operation-live_live_get button.opblock-summary-control")
    page.click("#operations-operation-live_live_get .try-out__btn")
    page.click("#operations-operation-live_live_get .execute")
    page.wait_for_selector("#operations-operation-live_live_get .live-responses-table .response-col_status >> text=200")

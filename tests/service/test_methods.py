"""HEAD wherever GET is served, and what `Allow` says."""

import json
from collections.abc import Iterator

import httpx
import pytest

from msdgs_serve.api.downloads import SceneFileResponse
from msdgs_serve.api.methods import METHODS
from msdgs_serve.browser import viewer_files
from tests.support.scene_files import write_scene
from tests.support.service import check_problem, in_this_process, serving

SHA256 = "0" * 64  # of the model of the test's scenes
FRAME = "/render?width=8&height=8"
GET_PATHS = [
    *("/", *(f"/viewer/{name}" for name in viewer_files()), "/viewer/nothing", "/nothing", "/scenes/", "/docs/?a=1"),
    *("/docs", "/redoc", "/openapi.json", "/static-offline-docs/swagger-ui.css", "/static-offline-docs/nothing"),
    *("/live", "/ready", "/scenes", "/scenes/balls", "/scenes/none", "/scenes/balls/report", "/scenes/balls/file"),
    *(FRAME, f"{FRAME}&format=npy", "/render?t=7", "/render?t=x", "/scenes/%00"),
]
ALLOW = {
    "/": "GET, HEAD, OPTIONS",
    "/docs": "GET, HEAD, OPTIONS",
    "/openapi.json": "GET, HEAD, OPTIONS",
    "/static-offline-docs/swagger-ui.css": "GET, HEAD, OPTIONS",
    "/viewer/service/main.js": "GET, HEAD, OPTIONS",
    "/live": "GET, HEAD, OPTIONS",
    "/metrics": "GET, HEAD, OPTIONS",
    "/render": "GET, HEAD, POST, OPTIONS",
    "/render/batch": "POST, OPTIONS",
    "/render/video": "POST, OPTIONS",
    "/scenes": "GET, HEAD, POST, OPTIONS",
    "/scenes/balls": "GET, HEAD, DELETE, OPTIONS",
    "/scenes/balls/file": "GET, HEAD, OPTIONS",
    "/scenes/balls/report": "GET, HEAD, OPTIONS",
}
CHANGES = {"date", "x-request-id", "server-timing"}


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    folder = tmp_path_factory.mktemp("scenes")
    error = {"psnr_worst": 60.0}
    write_scene(folder / "balls.onnx", measured_error={"rendered": error})
    points = [{"chosen": True, "plan": "network", "error": error}]
    report = {"format": "msdgs-report/1", "checkpoint_sha256": SHA256, "points": points}
    (folder / "balls.report.json").write_text(json.dumps(report))
    with serving(folder) as client:
        yield client


def headers(response: httpx.Response) -> dict[str, str]:
    return {name: value for name, value in response.headers.items() if name not in CHANGES}


@pytest.mark.parametrize("path", GET_PATHS)
def test_head_is_get_without_the_body(client: httpx.Client, path: str):
    for sent in ({}, {"If-None-Match": "*"}):
        whole, head = client.get(path, headers=sent), client.head(path, headers=sent)
        assert (head.status_code, head.content) == (whole.status_code, b"")
        assert headers(head) == headers(whole)
        assert whole.status_code == 304 or {"content-length", "transfer-encoding"} & headers(head).keys()


def test_every_get_of_the_document_has_its_head(client: httpx.Client):
    for path, calls in client.get("/openapi.json").json()["paths"].items():
        address = path.replace("{name}", "balls")
        assert client.head(address).status_code == (200 if "get" in calls else 405), path
    assert client.head("/metrics").headers["Content-Type"] == client.get("/metrics").headers["Content-Type"]


@in_this_process
def test_the_head_of_a_file_reads_no_file(client: httpx.Client, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(SceneFileResponse, "_read", lambda _: pytest.fail("was read"))
    assert client.head("/scenes/balls/file").status_code == 200


@pytest.mark.parametrize(("path", "allow"), ALLOW.items())
def test_allow_lists_the_methods_that_are_served(client: httpx.Client, path: str, allow: str):
    options = client.options(path)
    assert (options.status_code, options.headers["Allow"], options.content) == (204, allow, b"")
    for method in (*METHODS, "TRACE", "BREW"):
        response = client.request(method, path)
        assert (response.status_code == 405) == (method not in allow.split(", ")), method
        if response.status_code == 405:
            assert response.headers["Allow"] == allow
            if method != "HEAD":
                check_problem(response)


def test_where_nothing_is_there_is_nothing_to_allow(client: httpx.Client):
    for path in ("/nothing", "/render/nothing", "/scenes/balls/nothing", "/viewer"):
        response = client.options(path)
        check_problem(response, 404)
        assert "Allow" not in response.headers


def test_an_address_with_a_slash_too_many_leads_to_the_one_without(client: httpx.Client):
    for given, target in (
        ("/scenes/", "/scenes"),
        ("/scenes/balls/file/", "/scenes/balls/file"),
        ("/scenes/a%20b%0A/?x=1&y=%26", "/scenes/a%20b%0A?x=1&y=%26"),
        ("/docs//", "/docs"),
    ):
        response = client.get(given)
        assert response.status_code == 307
        assert response.headers["Location"].removeprefix(client.base_url.path.rstrip("/")) == target
    assert client.post("/scenes/").status_code == 307


@in_this_process
@pytest.mark.parametrize(
    "path",
    ["//evil.example/", "//evil.example", "/%2Fevil.example/", "/static-offline-docs/nothing/", "//", "/nothing/"],
)
def test_other_addresses_lead_nowhere(client: httpx.Client, path: str):
    check_problem(client.get(client.base_url.copy_with(raw_path=path.encode())), 404)

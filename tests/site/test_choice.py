"""The service's page with `--onnxruntime-web`: the user chooses who draws."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser, Page, Route, expect

from msdgs_serve.browser import RUNTIME_FILES, runtime_files
from msdgs_serve.scene.errors import InvalidInput
from tests.support.images import decode
from tests.support.pages import watched_page
from tests.support.processes import forget, wait_until_still
from tests.support.scene_files import write_scene
from tests.support.service import serving
from tests.support.sites import LOSE, LOST, NO_WEBGL2, RUNTIME, needs_runtime, psnr, stand_in
from tests.support.tolerances import tolerance

pytestmark = pytest.mark.slow

KEY = "0123456789abcdef"


def draw_here(page: Page) -> None:
    forget(page)
    page.locator("#source").get_by_text("Here").click()
    wait_until_still(page)


def stage(page: Page) -> np.ndarray:
    """The image as it stands on the page, [H, W, 3] from 0 to 1."""
    return decode(page.locator(".stage").screenshot(), "png")[0][..., :3] / 255


def test_only_with_the_runtime_may_scripts_compile_wasm(scene: Path, tmp_path: Path):
    with serving(scene) as client:
        page = client.get("/")
        assert "wasm" not in page.headers["content-security-policy"]
        assert "data-runtime" not in page.text
        assert client.get("/viewer/onnxruntime-web/ort.js").status_code == 404
    runtime = stand_in(tmp_path / "runtime")
    with serving(scene, onnxruntime_web=runtime) as client:
        page = client.get("/")
        policy = "default-src 'none'; script-src 'self' 'wasm-unsafe-eval'; worker-src 'self'; style-src 'self';"
        assert page.headers["content-security-policy"].startswith(policy)
        assert 'data-runtime="viewer/onnxruntime-web/"' in page.text
        for name, contents in runtime_files(runtime).items():
            answer = client.get(f"/viewer/onnxruntime-web/{name}")
            assert answer.content == contents
            assert answer.headers["content-security-policy"] == page.headers["content-security-policy"]
    (runtime / next(iter(RUNTIME_FILES))).unlink()
    with pytest.raises(InvalidInput, match="onnxruntime_web"), serving(scene, onnxruntime_web=runtime):
        pass


def test_without_it_the_page_offers_no_choice(page: Page, scene: Path):
    with serving(scene) as client:
        page.goto(str(client.base_url))
        wait_until_still(page)
        assert not page.locator("#source").is_visible()
        expect(page.locator("#status")).to_contain_text("drawn by the service")


@needs_runtime
def test_both_draw_the_same_also_with_a_key_and_after_the_file_has_changed(browser: Browser, tmp_path: Path):
    file = write_scene(tmp_path / "ball.onnx", steps=True)
    (tmp_path / "keys").write_text(f"read {KEY}")
    settings: dict[str, Any] = {"onnxruntime_web": RUNTIME, "api_keys_file": tmp_path / "keys"}
    with serving(tmp_path, **settings) as client, watched_page(browser, reduced_motion="reduce") as page:
        page.goto(f"{client.base_url}/#scene=ball&t=0.75&camera=1")
        page.locator("#key").fill(KEY)
        page.get_by_role("button", name="Use it").click()
        wait_until_still(page)
        with_borders = stage(page)
        forget(page)
        page.evaluate("location.hash = '#scene=ball&t=0.75&at=0,20,1.6,0,-1.2,0'")  # with a ball far from the middle
        wait_until_still(page)
        served = stage(page)
        draw_here(page)
        expect(page.locator("#status")).to_contain_text("drawn here")
        assert psnr(stage(page), served) >= tolerance("drawn_here_db")
        forget(page)
        page.select_option("#camera", "1")
        wait_until_still(page)
        assert psnr(stage(page), with_borders) >= tolerance("drawn_here_db"), "beside a stored camera"

        forget(page)
        write_scene(tmp_path / "new", static_color=(0.0, 0.0, 1.0), moving=0).rename(file)
        page.wait_for_function("() => document.querySelector('#timeline').hidden")
        wait_until_still(page)
        here = stage(page)
        page.evaluate(LOSE)
        expect(page.locator("#banner")).to_contain_text(LOST)
        page.locator("#source").get_by_text("Service").click()
        expect(page.locator("#status")).to_contain_text("drawn by the service")
        wait_until_still(page)
        expect(page.locator("#banner")).to_be_hidden()
        assert page.locator("#image + canvas").count() == 0
        assert psnr(here, stage(page)) >= tolerance("drawn_here_db")


@needs_runtime
def test_if_this_browser_cannot_the_service_draws(browser: Browser, scene: Path):
    with serving(scene, onnxruntime_web=RUNTIME) as client, watched_page(browser) as page:
        page.add_init_script(NO_WEBGL2)
        page.goto(str(client.base_url))
        wait_until_still(page)
        page.locator("#source").get_by_text("Here").click()
        expect(page.locator("#banner")).to_contain_text("WebGL2")
        expect(page.locator("#source [value=service]")).to_be_checked()
        wait_until_still(page)


def test_who_was_chosen_last_draws(page: Page, scene: Path, tmp_path: Path):
    held: list[Route] = []
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    with serving(scene, onnxruntime_web=stand_in(tmp_path / "runtime")) as client:
        page.route("**/local/source.js", lambda route: held.append(route))
        page.goto(str(client.base_url))
        wait_until_still(page)
        with page.expect_request("**/local/source.js"):
            page.locator("#source").get_by_text("Here").click()
        page.locator("#source").get_by_text("Service").click()
        held[0].continue_()
        page.evaluate("async () => void (await import('/viewer/local/source.js'))")
        forget(page)
        page.locator("#image").press("ArrowLeft")
        wait_until_still(page)
        expect(page.locator("#status")).to_contain_text("drawn by the service")
        assert not any(url.endswith("/file") for url in asked), "the browser opens the scene, too"

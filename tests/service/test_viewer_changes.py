"""The page while its address, its scene's file, and the service's answers change."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Page

from msdgs_serve.scene import Camera
from msdgs_serve.scene.camera import orbit
from tests.service.conftest import open_page
from tests.support.processes import bodies, forget, image, wait_for, wait_until_still
from tests.support.scene_files import metadata, write_scene
from tests.support.service import serving

pytestmark = pytest.mark.slow


def press(page: Page, key: str) -> None:
    """Press a key, for as long as a flight needs, and wait for the frame."""
    page.locator("#image").focus()
    forget(page)
    page.keyboard.press(key, delay=100)
    wait_until_still(page)


def test_an_address_shows_what_it_shows_in_a_new_tab(page: Page, tmp_path: Path):
    first, second = metadata().cameras
    narrow = replace(second, camera=Camera.from_fov(second.camera.camera_to_world, 32, 64, 20.0))
    write_scene(tmp_path / "ball.onnx", steps=True, cameras=(first, narrow))
    with serving(tmp_path) as client:
        asked, address = bodies(page), "#scene=ball&t=0.5&at=10,30,4,0,0,0"
        open_page(page, client, address)
        in_a_new_tab = asked[-1]
        page.locator("#steps").fill("0.5")
        page.select_option("#camera", label="view_90")
        page.wait_for_function("() => ['steps=0.5', 'camera=1'].every((part) => location.hash.includes(part))")
        forget(page)
        open_page(page, client, address)
        assert asked[-1] == in_a_new_tab
        assert page.locator("#camera").input_value() == ""


def test_an_address_has_the_lens_of_the_camera_that_was_moved(page: Page, tmp_path: Path):
    first, second = metadata().cameras
    narrow = replace(second, camera=Camera.from_fov(second.camera.camera_to_world, 32, 64, 20.0))
    write_scene(tmp_path / "ball.onnx", cameras=(first, narrow))
    with serving(tmp_path) as client:
        page.set_viewport_size({"width": 390, "height": 844})
        asked = bodies(page)
        open_page(page, client, "#scene=ball&camera=1")
        press(page, "ArrowUp")
        moved, address = asked[-1], page.url.removeprefix(f"{client.base_url}/")
        open_page(page, client, "#scene=ball&camera=0")
        press(page, "ArrowUp")
        assert "fov" not in page.url
        page.goto("about:blank")
        open_page(page, client, address)
        assert asked[-1] == moved


def strongest_in_the_middle(image: np.ndarray) -> int:
    return int(image[image.shape[0] // 2, image.shape[1] // 2].argmax())


def test_changed_files_are_shown(page: Page, tmp_path: Path):
    file = write_scene(tmp_path / "ball.onnx", static_color=(1.0, 0.0, 0.0), moving=0)
    with serving(tmp_path) as client:
        open_page(page, client, "#camera=1")
        wait_for(lambda: strongest_in_the_middle(image(page)) == 0)
        assert page.locator("#camera").input_value() == "1"
        write_scene(tmp_path / "new", static_color=(0.0, 1.0, 0.0), moving=0).rename(file)
        wait_for(lambda: strongest_in_the_middle(image(page)) == 1)
        write_scene(tmp_path / "new", moving=0, cameras=metadata().cameras[:1]).rename(file)
        page.wait_for_function("() => location.hash.includes('at=')")
        assert page.locator("#camera option").all_inner_texts() == ["Free view", "view_0"]
        away = file.rename(tmp_path / "away")
        page.get_by_text("ball is gone.").wait_for()
        forget(page)
        away.rename(file)
        wait_until_still(page)
        assert not page.locator("#banner").is_visible()


def test_the_camera_has_the_view_of_a_changed_file(page: Page, tmp_path: Path):
    file = write_scene(tmp_path / "ball.onnx")
    center, up = np.array([3.0, 0.5, 0.0]), np.array([1.0, 0.0, 0.0])
    cameras = tuple(
        replace(each, name=f"new_{i}", camera=Camera.from_fov(orbit(center, 8.0, 90 * i, 20, up), 64, 48, 40.0))
        for i, each in enumerate(metadata().cameras)
    )
    with serving(tmp_path) as client:
        asked = bodies(page)
        open_page(page, client, "#scene=ball&camera=1")
        write_scene(tmp_path / "new", cameras=cameras, bounds=((-5.0,) * 3, (5.0,) * 3)).rename(file)
        page.locator("#camera option", has_text="new_0").wait_for(state="attached")
        press(page, "ArrowUp")
        assert asked[-1]["camera"]["target"] == pytest.approx(center, abs=1e-3), "the stored camera's new pose"
        press(page, "r")
        shown = asked[-1]["camera"]
        assert [*shown["target"], shown["distance"]] == pytest.approx([*center, 8.0], abs=1e-3)
        press(page, "d")
        way = np.subtract(asked[-1]["camera"]["target"], shown["target"])
        assert abs(way @ up) < 1e-3 * np.linalg.norm(way), "not level"


def test_the_reason_why_a_scene_is_broken_stays(page: Page, tmp_path: Path):
    write_scene(tmp_path / "ball.onnx")
    (tmp_path / "bad.onnx").write_bytes(b"")
    with serving(tmp_path) as client:
        page.clock.install()
        open_page(page, client, "#scene=ball")
        asked: list[str] = []
        page.on("request", lambda request: asked.append(request.url.removeprefix(f"{client.base_url}/")))

        def assert_it_stays(reason: str, *without: str) -> None:
            page.get_by_text(reason).wait_for()
            asked.clear()
            for _ in range(3):
                with page.expect_response("**/scenes"):
                    page.clock.fast_forward(5000)
            assert not set(without) & set(asked), "it tries again, though nothing has changed"
            assert page.get_by_text(reason).is_visible()

        page.locator("#scenes").get_by_text("bad", exact=True).click()
        assert_it_stays("The scene's file is invalid", "ready")
        problem = json.dumps({"detail": "No pose at this time."})
        page.route("**/render", lambda route: route.fulfill(status=503, body=problem))
        page.keyboard.press("r")
        assert_it_stays("No pose at this time.", "ready", "render")
        page.unroute("**/render")
        press(page, "r")
        assert not page.locator("#banner").is_visible()


def test_it_waits_for_a_proxy_that_finds_no_service(page: Page, scene: Path):
    with serving(scene) as client:
        open_page(page, client)
        page.route("**/render", lambda route: route.fulfill(status=503, body="no healthy upstream"))
        page.keyboard.press("r")
        page.get_by_text("The service doesn’t answer").wait_for()
        forget(page)
        page.unroute("**/render")
        wait_until_still(page)
        assert not page.locator("#banner").is_visible()

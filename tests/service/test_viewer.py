"""The page at /, in a browser: loading, dragging, playing, channels, and the message if the service goes away."""

import itertools
import json
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from playwright.sync_api import Browser, Page, Route

from msdgs_serve.browser import VIEWER, viewer_files
from msdgs_serve.imaging import ImageFormat
from tests.service.conftest import MILLISECONDS, open_page
from tests.support.images import decode
from tests.support.processes import HOLD_FRAMES, bodies, forget, image, wait_for, wait_until_still
from tests.support.scene_files import write_scene
from tests.support.service import serving

pytestmark = pytest.mark.slow

KEY = "0123456789abcdef"
REPORT = {
    "format": "msdgs-report/1",
    "checkpoint_sha256": "0" * 64,
    "machine": {"processor": "a processor", "threads": 2},
    "min_psnr": 50.0,
    "points": [
        {
            "plan": plan, "front": True, "chosen": plan == "prefix", "pruning_db": None, "bytes": 1e6,
            "milliseconds": {"total": {"min": milliseconds}}, "error": {"psnr_worst": decibels},
        }
        for plan, milliseconds, decibels in (("network", 40.0, 95.0), ("prefix", 20.0, 60.0))
    ],
}  # fmt: skip


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scenes")
    chosen = next(point for point in REPORT["points"] if point["chosen"])
    described = {"plan": chosen["plan"], "measured_error": {"rendered": chosen["error"]}}
    write_scene(folder / "balls.onnx", steps=True, **described)
    write_scene(folder / "it's.onnx", static_color=(0.0, 0.0, 1.0), moving=0)
    (folder / "balls.report.json").write_text(json.dumps(REPORT))
    return folder


@pytest.fixture(scope="module")
def client(scenes: Path) -> Iterator[httpx.Client]:
    with serving(scenes) as client:
        yield client


@pytest.fixture
def opened(page: Page, client: httpx.Client) -> Page:
    return open_page(page, client)


def test_only_its_own_files_may_be_loaded(client: httpx.Client):
    page = client.get("/")
    assert page.headers["content-type"].startswith("text/html")
    assert page.headers["content-security-policy"].startswith("default-src 'none'; script-src 'self';")
    assert client.get("/", headers={"If-None-Match": page.headers["etag"]}).status_code == 304
    for name in re.findall(r'(?:src|href)="viewer/([^"]*)"', page.text):
        assert client.get(f"/viewer/{name}").status_code == 200
    for name in ("../index.html", "..%2F__init__.py", "nothing.js", "%2Fetc%2Fpasswd"):
        assert client.get(f"/viewer/{name}").status_code == 404
    assert not re.search(r"https?://", page.text), "something from elsewhere"
    assert {str(path.relative_to(VIEWER)) for path in VIEWER.rglob("*") if path.is_file()} == set(viewer_files())


def test_it_shows_the_scene_as_the_service_draws_it(opened: Page, client: httpx.Client):
    asked = bodies(opened)
    opened.reload()
    wait_until_still(opened)
    frame = client.post("/render", json=asked[-1])
    np.testing.assert_array_equal(image(opened), decode(frame.content, "png")[0])
    assert opened.title() == "balls · msdgs"
    assert opened.locator("#scenes li").all_inner_texts() == ["balls", "it's"]
    assert opened.locator("#facts").inner_text().startswith("Gaussians")


def test_dragging_orbits_and_ends_in_full_quality(opened: Page):
    before, asked = image(opened), bodies(opened)
    opened.mouse.move(200, 200)
    forget(opened)
    opened.mouse.down()
    for step in range(10, 100, 10):
        opened.mouse.move(200 + step, 200 + step // 2)
        opened.wait_for_timeout(20)
    opened.mouse.up()
    wait_until_still(opened)
    first, last = asked[0], asked[-1]
    assert (first["format"], last["format"]) == ("jpeg", "png")
    assert first["width"] <= last["width"]
    assert last["camera"]["azimuth"] != 30
    assert last["camera"]["elevation"] > 20
    assert np.abs(image(opened).astype(int) - before).max() > 50
    assert "at=" in opened.url


def test_wheel_keys_and_shift_drag_move_the_camera(opened: Page):
    asked = bodies(opened)

    def camera_after(act: Any) -> dict[str, Any]:
        count = len(asked)
        forget(opened)
        act()
        wait_until_still(opened)
        assert len(asked) > count
        return asked[-1]["camera"]

    def shift_drag() -> None:
        opened.keyboard.down("Shift")
        opened.mouse.move(200, 200)
        opened.mouse.down()
        opened.mouse.move(240, 200)
        opened.mouse.up()
        opened.keyboard.up("Shift")

    opened.mouse.move(200, 200)
    nearer = camera_after(lambda: opened.mouse.wheel(0, -300))
    assert nearer["distance"] < 5
    panned = camera_after(shift_drag)
    assert panned["target"] != nearer["target"]
    assert panned["distance"] == nearer["distance"]
    rotated = camera_after(lambda: opened.keyboard.press("ArrowLeft"))
    assert rotated["azimuth"] != panned["azimuth"]
    flown = camera_after(lambda: opened.keyboard.press("w", delay=100))
    assert flown["target"] != rotated["target"]
    assert camera_after(lambda: opened.keyboard.press("R"))["target"] == [0, 0, 0], "with Caps Lock"


def test_two_fingers_zoom(browser: Browser, client: httpx.Client):
    with browser.new_context(viewport={"width": 390, "height": 780}, has_touch=True, is_mobile=True) as context:
        context.set_default_timeout(MILLISECONDS)
        page = open_page(context.new_page(), client)
        asked = bodies(page)
        touch = context.new_cdp_session(page)
        forget(page)
        for kind, spread in (("touchStart", 20), ("touchMove", 60), ("touchMove", 90)):
            points = [{"x": 195 + side * spread, "y": 350, "id": side + 1} for side in (-1, 1)]
            touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
        touch.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
        wait_until_still(page)
        assert asked[-1]["camera"]["distance"] < 3
        assert page.evaluate("document.documentElement.scrollWidth") <= 390, "wider than a phone"


def began_again(asked: list[dict[str, Any]]) -> bool:
    return any(later["t"] < earlier["t"] for earlier, later in itertools.pairwise(asked))


def test_it_plays_with_one_request_ahead(opened: Page):
    asked = bodies(opened)
    opened.evaluate(HOLD_FRAMES)
    opened.select_option("#speed", "2")
    opened.get_by_role("button", name="Play").click()
    opened.wait_for_function("() => window.mostWaiting >= 2")
    opened.wait_for_timeout(300)
    opened.evaluate("window.release()")
    wait_for(lambda: opened.wait_for_timeout(100) or (len({body["t"] for body in asked}) > 5 and began_again(asked)))
    opened.get_by_role("button", name="Pause").click()
    wait_until_still(opened)
    assert opened.evaluate("[window.waiting, window.mostWaiting]") == [0, 2]
    shown = float(opened.locator("#time-text").inner_text().removeprefix("t "))
    assert shown == pytest.approx(asked[-1]["t"], abs=0.00051)


def test_it_stops_at_the_end_without_loop(opened: Page):
    opened.get_by_role("button", name="Loop").click()
    opened.get_by_label("Depth").press("Space")
    opened.get_by_role("button", name="Pause").wait_for()
    opened.locator("#time").fill("0.9")
    opened.locator("#time").press("Space")
    opened.get_by_role("button", name="Play").wait_for()
    assert opened.locator("#time-text").inner_text() == "t 1.000"


def test_depth_count_and_motion(opened: Page):
    asked = bodies(opened)
    for label, channel in (("Depth", "depth"), ("Count", "gaussians"), ("Motion", "motion")):
        before = image(opened)
        with opened.expect_response("**/render") as answer:
            opened.get_by_text(label, exact=True).click()
        assert answer.value.status == 200
        opened.wait_for_function("(c) => location.hash.includes(`view=${c}`)", arg=channel)
        assert asked[-1]["channels"] == [channel]
        assert np.abs(image(opened).astype(int) - before).max() > 50
    opened.locator("#time").fill("1")
    opened.wait_for_function("() => location.hash.includes('t=1&')")
    assert asked[-1]["t"] + asked[-1]["dt"] == 1, "motion needs a later time, which the end doesn't have"


def test_the_slider_of_layers(opened: Page):
    asked = bodies(opened)
    opened.locator("#time").fill("1")
    opened.wait_for_function("() => location.hash.includes('t=1&')")
    all_layers = image(opened)
    opened.locator("#steps").fill("0.5")
    opened.wait_for_function("() => location.hash.includes('steps=0.5&')")
    assert opened.locator("#steps-text").inner_text() == "0.5 of 1"
    assert asked[-1]["steps"] == 0.5
    assert np.abs(image(opened).astype(int) - all_layers).max() > 50
    opened.locator("#steps").fill("1")
    opened.wait_for_function("() => !location.hash.includes('steps')")
    assert "steps" not in asked[-1]
    opened.goto(opened.url.split("#")[0] + "#scene=balls&t=0.25&steps=0.25")
    opened.get_by_text("0.25 of 1").wait_for()
    opened.locator("#scenes").get_by_text("it's").click()
    opened.wait_for_function("() => location.hash.includes('scene=it')")
    assert not opened.locator("#layers").is_visible()


def test_a_camera_of_the_scene_keeps_its_proportions(opened: Page):
    asked = bodies(opened)
    opened.select_option("#camera", label="view_90")
    opened.wait_for_function("() => location.hash.includes('camera=1')")
    assert asked[-1]["camera"] == {"type": "scene", "index": 1}
    assert abs(asked[-1]["width"] / asked[-1]["height"] - 64 / 48) < 0.01
    opened.locator("#image").focus()
    opened.keyboard.press("ArrowUp")
    opened.wait_for_function("() => location.hash.includes('at=')")
    taken_over = asked[-1]["camera"]
    assert (taken_over["type"], taken_over["azimuth"]) == ("orbit", 90)
    assert opened.locator("#camera").input_value() == ""


def test_another_scene_and_the_address_of_this_one(opened: Page):
    opened.locator("#scenes").get_by_text("it's").click()
    opened.wait_for_function("() => location.hash.includes('scene=it')")
    assert opened.locator("#title").inner_text() == "it's"
    assert not opened.locator("#report").is_visible()
    opened.goto(opened.url.split("#")[0] + "#scene=balls&t=0.25&view=depth&at=10,30,4,0,0,0.5")
    opened.get_by_text("t 0.250").wait_for()
    assert opened.locator("#title").inner_text() == "balls"
    assert opened.get_by_label("Depth").is_checked()


def test_the_scene_that_was_chosen_last_is_opened(opened: Page):
    held: list[Route] = []
    opened.route("**/scenes/it*", lambda route: held.append(route))
    opened.locator("#scenes").get_by_text("it's").click()
    forget(opened)
    with opened.expect_event("requestfailed", lambda request: "scenes/it" in request.url):
        opened.locator("#scenes").get_by_text("balls").click()
    held[0].abort()
    wait_until_still(opened)
    assert not opened.locator("#banner").is_visible()


def test_after_a_refused_frame_others_are_asked_for(page: Page, client: httpx.Client):
    page.goto(f"{client.base_url}/#scene=balls&at=0,95,4,0,0,0")
    page.get_by_text("elevation").wait_for()
    page.locator("#image").focus()
    page.keyboard.press("ArrowDown")
    wait_until_still(page)
    assert not page.locator("#banner").is_visible()


def test_a_later_look_draws_missing_thumbnails_and_keeps_the_focus(page: Page, client: httpx.Client):
    answers: list[bool] = []
    page.route(re.compile(r"/render\?"), lambda route: route.continue_() if answers else route.abort())
    open_page(page, client)
    with page.expect_event("requestfailed", lambda request: "render?" in request.url):
        page.locator("#scenes button").first.focus()  # scrolls to the list
    with page.expect_response(re.compile(r"/render\?scene=balls")):
        answers.append(True)
    assert page.evaluate("document.activeElement.innerText.trim()") == "balls"


def test_the_report_is_drawn(opened: Page):
    dots = opened.locator("#diagram .dot")
    assert dots.count() == 2
    assert opened.locator("#report-point").inner_text().startswith("Chosen: prefix")
    dots.last.focus()
    assert "95.0 dB" in opened.locator("#report-point").inner_text()
    assert opened.locator("#diagram").get_by_text("allowed: 50 dB").is_visible()


def test_a_report_of_limited_bytes_has_no_line_of_allowed_error(page: Page, client: httpx.Client):
    answer = json.dumps(REPORT | {"min_psnr": None})
    page.route("**/report", lambda route: route.fulfill(body=answer, content_type="application/json"))
    open_page(page, client)
    page.locator("#diagram .dot").last.wait_for()
    heights = [float(dot.get_attribute("cy") or "nan") for dot in page.locator("#diagram .dot").all()]
    assert abs(heights[0] - heights[1]) > 100  # over the whole axis
    assert page.locator("#diagram").get_by_text("allowed").count() == 0


def test_the_frame_as_a_command_and_as_files(browser: Browser, client: httpx.Client):
    permissions = ["clipboard-read", "clipboard-write"]
    with browser.new_context(viewport={"width": 820, "height": 420}, permissions=permissions) as context:
        context.set_default_timeout(MILLISECONDS)
        page = open_page(context.new_page(), client, "#scene=it's&t=0.5")
        page.get_by_role("button", name="curl").click()
        page.get_by_text("Copied.").wait_for()
        words = shlex.split(page.evaluate("navigator.clipboard.readText()"))
        assert words[:2] == ["curl", str(client.base_url.join("render"))]
        answer = client.post("/render", content=words[-1], headers={"Content-Type": "application/json"})
        np.testing.assert_array_equal(decode(answer.content, "png")[0], image(page))
        page.route("**/render", lambda route: route.fulfill(status=504, json={"detail": "It takes too long."}))
        page.get_by_role("button", name="EXR").click()
        page.get_by_text("It takes too long.").wait_for()
        page.unroute("**/render")
        files: list[tuple[str, ImageFormat, int]] = [("PNG", "png", 3), ("EXR", "exr", 5)]
        for label, image_format, channels in files:
            with page.expect_download() as download:
                page.get_by_role("button", name=label, exact=True).click()
            assert download.value.suggested_filename == f"it's-0.5.{image_format}"
            content = Path(download.value.path()).read_bytes()
            assert decode(content, image_format)[0].shape == (*image(page).shape[:2], channels)
            assert not page.locator("#banner").is_visible()
        with page.expect_download() as download:
            page.get_by_role("button", name="Download the file").click()
        assert download.value.suggested_filename == "it's.onnx"
        assert Path(download.value.path()).read_bytes() == client.get("/scenes/it's/file").content


def test_it_reports_an_unavailable_service_and_recovers(page: Page, scenes: Path):
    with serving(scenes) as client:
        port = client.base_url.port
        open_page(page, client)
    page.locator("#image").focus()
    page.keyboard.press("ArrowLeft")
    page.get_by_text("The service doesn’t answer").wait_for()
    forget(page)
    assert port is not None
    with serving(scenes, port=port):
        wait_until_still(page)
        assert not page.locator("#banner").is_visible()


def test_a_frame_whose_connection_breaks_is_asked_for_again(page: Page, client: httpx.Client):
    open_page(page, client)
    page.evaluate("""() => {
        const whole = Response.prototype.blob;
        Response.prototype.blob = function () {
            if (!this.url.endsWith("/render")) return whole.call(this);
            Response.prototype.blob = whole;
            return Promise.reject(new TypeError());
        };
    }""")
    page.locator("#image").focus()
    page.keyboard.press("ArrowLeft")
    page.get_by_text("The service doesn’t answer").wait_for()
    forget(page)
    wait_until_still(page)
    assert not page.locator("#banner").is_visible()


def test_an_address_that_is_entered_while_scenes_are_listed_is_shown(opened: Page):
    held: list[Route] = []
    opened.route("**/scenes", lambda route: held.append(route))
    with opened.expect_request("**/scenes"):
        opened.evaluate("location.hash = '#scene=balls&t=0.25&at=10,30,4,0,0,0.5'")
    opened.evaluate("history.replaceState(null, '', '#scene=balls&t=0.75&at=10,30,4,0,0,0.5')")  # as a frame does
    held[0].continue_()
    opened.unroute("**/scenes")
    opened.get_by_text("t 0.250").wait_for()


def test_a_key_is_asked_for_and_kept_for_the_tab(page: Page, scenes: Path, tmp_path: Path):
    (tmp_path / "keys").write_text(f"read {KEY}")
    with serving(scenes, api_keys_file=tmp_path / "keys") as client:
        page.clock.install()
        page.goto(f"{client.base_url}/#scene=balls")
        page.locator("#key").wait_for()
        page.keyboard.press("Escape")
        asked: list[str] = []
        page.on("request", lambda request: asked.append(request.url))
        page.clock.fast_forward(MILLISECONDS)
        page.get_by_role("button", name="Reset").click()
        page.get_by_role("button", name="API key").click()
        assert asked == [], "it waits for the user"
        page.locator("#key").fill("wrong")
        page.get_by_role("button", name="Use it").click()
        page.get_by_text("The service asks for a key.").wait_for()
        page.locator("#key").fill(KEY)
        page.get_by_role("button", name="Use it").click()
        wait_until_still(page)
        page.reload()
        wait_until_still(page)
        assert not page.locator("#key-dialog").is_visible()
        assert not page.locator("#docs").is_visible(), "a link without the key"


def test_a_service_that_allows_fewer_pixels(page: Page, scenes: Path):
    with serving(scenes, max_pixels=100 * 100) as client:
        asked = bodies(page)
        open_page(page, client)
        assert asked[-1]["width"] * asked[-1]["height"] <= 100 * 100

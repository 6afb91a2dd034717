"""What the page offers follows from the scene: links to scenes that aren't there, static scenes, motion, the list."""

from collections.abc import Iterator
from pathlib import Path
from urllib.parse import quote

import httpx
import pytest
from playwright.sync_api import Browser, Page, expect

from tests.service.conftest import MILLISECONDS, open_page
from tests.support.processes import bodies, forget, image, wait_until_still
from tests.support.scene_files import write_scene
from tests.support.service import serving

pytestmark = pytest.mark.slow

ACCENT, DECOMPOSED = "caf\u00e9", "cafe\u0301"
LAST = "zebra"
MANY = [f"scene_{number:02}" for number in range(20)]


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scenes")
    for name in ("balls", ACCENT, *MANY, LAST):
        write_scene(folder / f"{name}.onnx")
    write_scene(folder / "still.onnx", moving=0)
    write_scene(folder / "moment.onnx", time_range=(0.5, 0.5))
    write_scene(folder / "switched.onnx", plan="frames:3", layers=())
    return folder


@pytest.fixture(scope="module")
def client(scenes: Path) -> Iterator[httpx.Client]:
    with serving(scenes) as client:
        yield client


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ("walk", "There is no scene “walk”."),
        ("Balls", "There is no scene “Balls”."),
        ("balls.onnx", "There is no scene “balls.onnx”."),
        ("../balls", "There is no scene “../balls”."),
        ("<b>&%+ 'ü\u202e", "There is no scene “<b>&%+ 'ü\u202e”."),
        ("a" * 5000, "There is no scene “" + "a" * 60 + "…”."),
        ("", "The link doesn’t say which scene."),
        ("  ", "The link doesn’t say which scene."),
    ],
)
def test_a_link_to_a_scene_that_is_not_there_says_so(page: Page, client: httpx.Client, asked: str, said: str):
    drawn = bodies(page)
    page.goto(f"{client.base_url}/#scene={quote(asked, safe='')}&t=0.5&at=10,20,3,0,0,0")
    expect(page.locator("#banner")).to_contain_text(said)
    assert drawn == [], "another scene"
    assert page.title() == "msdgs"
    assert not page.locator("#image").is_visible()
    assert page.locator("#scenes [aria-current]").count() == 0
    page.locator("#scenes").get_by_text("balls", exact=True).click()
    wait_until_still(page)
    assert page.title() == "balls · msdgs"
    assert not page.locator("#banner").is_visible()


def test_a_link_that_is_followed_in_the_page_shows_nothing_of_the_scene_before(page: Page, client: httpx.Client):
    open_page(page, client)
    page.evaluate("location.hash = '#scene=walk'")
    page.get_by_text("There is no scene “walk”.").wait_for()
    drawn = bodies(page)
    for key in ("r", " ", "2", "."):
        page.keyboard.press(key)
    assert not page.locator("#image").is_visible()
    assert not page.get_by_role("button", name="Copy link").is_visible()
    assert drawn == []
    page.evaluate("location.hash = '#scene=still'")
    wait_until_still(page)
    assert page.title() == "still · msdgs"


def test_a_scene_that_comes_later_is_shown_as_the_link_says(page: Page, tmp_path: Path):
    write_scene(tmp_path / "balls.onnx")
    with serving(tmp_path) as client:
        asked = bodies(page)
        page.goto(f"{client.base_url}/#scene=walk&t=0.25")
        page.get_by_text("There is no scene “walk”.").wait_for()
        write_scene(tmp_path / "new").rename(tmp_path / "walk.onnx")
        wait_until_still(page)
        assert (asked[-1]["scene"], asked[-1]["t"]) == ("walk", 0.25)


def test_a_scene_that_is_deleted_before_it_is_opened(page: Page, tmp_path: Path):
    file = write_scene(tmp_path / "walk.onnx")
    write_scene(tmp_path / "balls.onnx")
    with serving(tmp_path) as client:
        open_page(page, client)
        page.route("**/scenes", lambda route: route.abort("aborted"))  # the list isn't renewed
        file.unlink()
        page.locator("#scenes").get_by_text("walk").click()
        page.get_by_text("There is no scene “walk”.").wait_for()
        assert not page.locator("#image").is_visible()


def test_accents_are_the_same_however_they_are_written(page: Page, client: httpx.Client):
    open_page(page, client, f"#scene={quote(DECOMPOSED)}")
    assert page.title() == f"{ACCENT} · msdgs"


@pytest.mark.parametrize("scene", ["still", "moment"])
def test_a_static_scene_has_no_timeline_and_plays_nothing(page: Page, client: httpx.Client, scene: str):
    open_page(page, client)
    page.locator("#image").focus()
    page.keyboard.press("Space")
    page.get_by_role("button", name="Pause").wait_for()
    forget(page)
    page.locator("#scenes").get_by_text(scene).click()
    wait_until_still(page)
    assert not page.locator("#timeline").is_visible()
    asked = bodies(page)
    for key in (" ", ",", "."):
        page.keyboard.press(key)
    page.locator("#image").focus()
    page.keyboard.press("Space")
    page.keyboard.press("3")
    forget(page)
    page.keyboard.press("r")
    wait_until_still(page)
    assert len({body["t"] for body in asked}) == 1
    assert all("channels" not in body for body in asked)
    forget(page)
    page.locator("#scenes").get_by_text("balls").click()
    wait_until_still(page)
    assert page.get_by_role("button", name="Play").is_visible()


@pytest.mark.parametrize("scene", ["still", "moment", "switched"])
def test_motion_is_offered_only_where_there_is_some(page: Page, client: httpx.Client, scene: str):
    asked = bodies(page)
    open_page(page, client, f"#scene={scene}&view=motion")
    expect(page.locator("#notice")).to_contain_text("Nothing moves")
    assert all("channels" not in body for body in asked)
    assert page.get_by_label("Color").is_checked()
    expect(page.get_by_label("Motion")).to_be_disabled()
    page.get_by_text("Depth", exact=True).click()
    expect(page.locator("#notice")).to_be_empty()
    page.get_by_text("Motion", exact=True).click(force=True)
    expect(page.locator("#notice")).to_have_text("Nothing moves in this scene that could be shown as motion.")
    expect(page.get_by_label("Depth")).to_be_checked()
    forget(page)
    page.locator("#image").press("ArrowLeft")
    wait_until_still(page)
    assert asked[-1]["channels"] == ["depth"]
    assert not any("motion" in body.get("channels", ()) for body in asked)
    page.locator("#scenes").get_by_text("balls").click()
    page.get_by_text("Motion", exact=True).click()
    page.wait_for_function("() => location.hash.includes('view=motion')")
    forget(page)
    page.locator("#scenes").get_by_text(scene, exact=True).click()
    wait_until_still(page)
    expect(page.locator("#notice")).to_contain_text("as motion: this is the color.")
    assert "channels" not in asked[-1]


def test_a_view_that_does_not_exist_is_named(page: Page, client: httpx.Client):
    open_page(page, client, "#scene=balls&view=velocity")
    expect(page.locator("#notice")).to_contain_text("a view that this page doesn’t have")


@pytest.mark.parametrize("width", [1280, 390])
def test_the_list_scrolls_to_the_current_scene(page: Page, client: httpx.Client, width: int):
    page.set_viewport_size({"width": width, "height": 700})

    def assert_in_sight() -> None:
        expect(page.locator("#scenes [aria-current]")).to_be_visible()
        inside = page.evaluate("""() => {
            const list = document.getElementById("scenes").getBoundingClientRect();
            const item = document.querySelector("#scenes [aria-current]").getBoundingClientRect();
            return item.left >= list.left && item.right <= list.right && item.top >= list.top
                && item.bottom <= list.bottom; }""")
        assert inside
        assert page.evaluate("scrollY") == 0, "the page itself"

    open_page(page, client, f"#scene={LAST}")
    assert_in_sight()
    page.evaluate("document.getElementById('scenes').scrollTo(0, 0)")
    with page.expect_response("**/scenes"):
        pass
    assert page.evaluate("document.getElementById('scenes').scrollTop") == 0, "only when another one is opened"
    forget(page)
    page.evaluate(f"location.hash = '#scene={MANY[9]}'")
    wait_until_still(page)
    assert_in_sight()


def test_the_link_is_copied_without_permission_too(browser: Browser, client: httpx.Client):
    with browser.new_context(viewport={"width": 1280, "height": 700}) as context:
        context.set_default_timeout(MILLISECONDS)
        page = open_page(context.new_page(), client, "#scene=balls&t=0.25&view=depth")
        page.evaluate("""() => {
            navigator.clipboard.writeText = () => Promise.reject(new DOMException("", "NotAllowedError"));
            document.addEventListener("copy", () => (window.copied = String(document.activeElement.value)));
        }""")
        page.get_by_role("button", name="Copy link").click()
        page.get_by_text("Copied.").wait_for()
        link = page.evaluate("window.copied")
        assert link == page.url
        assert page.evaluate("document.activeElement.textContent") == "Copy link"
        shown = image(page)
        other = open_page(context.new_page(), client, link.removeprefix(f"{client.base_url}/"))
        assert (image(other) == shown).all()
        page.evaluate("document.execCommand = () => false")
        page.get_by_role("button", name="Copy link").click()
        page.get_by_role("heading", name="The link to this view").wait_for()
        assert page.locator("#text").input_value() == link

"""A site in Chromium: it plays, draws what the service draws, and does nothing while nothing changes."""

from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, Route, expect

from tests.support.images import decode
from tests.support.pages import watched_page
from tests.support.processes import ROOT, forget, wait_until_still
from tests.support.sites import drawn_by_the_service, needs_runtime, picture, psnr
from tests.support.tolerances import tolerance

pytestmark = [pytest.mark.slow, needs_runtime]

COUNT_WORK = """() => {
    [window.work, window.times] = [0, []];
    const counted = (holder, name) => {
        const call = holder[name];
        holder[name] = function (...values) {
            window.work += 1;
            if (values[0]?.kind === "pose" && "t" in values[0]) times.push(values[0].t);
            return call.apply(this, values);
        };
    };
    counted(window, "requestAnimationFrame");
    counted(Worker.prototype, "postMessage");
    counted(WebGL2RenderingContext.prototype, "drawArrays");
}"""
"""Counts what a page does by itself: animation frames, messages to workers and draw calls. Lists times of poses."""
TRIES = 40
HIDE = """(isHidden) => {
    Object.defineProperty(document, "hidden", { value: isHidden, configurable: true });
    document.dispatchEvent(new Event("visibilitychange"));
}"""


def comes_to_rest(page: Page) -> bool:
    """Whether half a second passes without work that is counted, once the last frames are drawn."""
    for _ in range(TRIES):
        page.evaluate("() => { window.work = 0; }")
        page.wait_for_timeout(500)
        if page.evaluate("work") == 0:
            return True
    return False


def red(page: Page) -> int:
    """How many pixels of the image on the page are more red than anything else."""
    pixels = decode(page.locator(".stage").screenshot(), "png")[0][..., :3].astype(int)
    return int((pixels[..., 0] > pixels[..., 1:].max(axis=-1) + 50).sum())


def test_it_plays_from_the_folder_alone(page: Page, site: Path, server: str):
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    page.goto(f"{server}/site/")
    assert page.locator("#preview").evaluate("(image) => image.complete && image.naturalWidth") == 1200
    page.get_by_role("button", name="Pause").wait_for()
    expect(page.locator("#status")).to_contain_text("drawn here")
    page.wait_for_function("() => Number(document.getElementById('time').value) > 0.1")
    assert page.url == f"{server}/site/", "who opens the address again doesn't see it play"
    assert page.locator("#preview").count() == 0
    assert page.title() == page.locator("h1").inner_text() == "Balls"
    assert [url for url in asked if not url.startswith((f"{server}/site/", "blob:"))] == []
    assert picture(page).std() > 0.1
    page.get_by_role("button", name="Play").wait_for()

    page.locator("#image").focus()
    page.keyboard.press("ArrowLeft")
    page.wait_for_function("() => location.hash.includes('at=35,20')")
    wait_until_still(page)
    page.evaluate(COUNT_WORK)
    assert comes_to_rest(page), "it works although nothing changes"

    page.keyboard.press("Space")
    page.wait_for_function("() => times.length > 3")
    assert any(240 * t % 1 for t in page.evaluate("times")), "only those of the service"
    page.evaluate(HIDE, True)
    page.wait_for_function("() => new Promise((d) => setTimeout(() => d(work), 300)).then((w) => w === work)")
    before = page.evaluate("work = 0, document.getElementById('time').value")
    page.wait_for_timeout(300)
    assert page.evaluate("[work, document.getElementById('time').value]") == [0, before], "it works while it is hidden"
    page.evaluate(HIDE, False)
    page.wait_for_function("() => work > 10")


def test_it_draws_what_the_service_draws_and_fills_the_screen(browser: Browser, site: Path, server: str, scene: Path):
    with watched_page(browser, reduced_motion="reduce") as page:
        page.goto(f"{server}/site/")
        wait_until_still(page)
        assert page.get_by_role("button", name="Play").is_visible(), "it plays although that isn't wanted"
        for t, azimuth, elevation in ((0.0, 30, 20), (0.7, 200, -35)):
            forget(page)
            page.evaluate(f"location.hash = '#t={t}&at={azimuth},{elevation},5,0,0,0'")
            wait_until_still(page)
            got = picture(page)
            height, width, _ = got.shape
            wanted = drawn_by_the_service(scene, t, azimuth, elevation, (width, height))
            assert wanted.std() > 0.1
            assert psnr(got, wanted) >= tolerance("drawn_here_db")
        page.get_by_role("button", name="Full screen").click()
        page.wait_for_function("() => document.fullscreenElement?.matches('main')")
        page.keyboard.press("F")
        page.wait_for_function("() => !document.fullscreenElement")
        with page.expect_download() as download:
            page.get_by_role("button", name="Download the file").click()
        assert Path(download.value.path()).read_bytes() == scene.read_bytes()


def test_in_a_frame_of_another_page_it_has_the_stage_alone(page: Page, folder: Path, site: Path, server: str):
    (folder / "other.html").write_text('<iframe src="site/" width="500" height="400" allow="fullscreen"></iframe>')
    page.goto(f"{server}/other.html")
    inside = page.frame_locator("iframe")
    inside.get_by_role("button", name="Pause").wait_for()
    assert not inside.locator("aside").is_visible()
    box = inside.locator(".stage").bounding_box()
    assert box is not None
    assert box["height"] > 250
    for width, height, last in ((480, 300, "#status"), (320, 180, "#timeline")):
        page.locator("iframe").evaluate(
            "(frame, size) => Object.assign(frame, size)", {"width": width, "height": height}
        )
        ends = inside.locator(last).evaluate("(line) => [line.getBoundingClientRect().bottom, innerHeight]")
        assert ends[0] <= ends[1] == height
        assert inside.locator("#image").evaluate("(image) => image.clientHeight") > 100


def test_in_a_frame_without_an_origin_it_says_what_the_frame_needs(
    browser: Browser, folder: Path, site: Path, server: str
):
    (folder / "sandbox.html").write_text(
        '<iframe src="site/" width="500" height="400" sandbox="allow-scripts"></iframe>'
    )
    with browser.new_context() as context:
        page = context.new_page()
        page.goto(f"{server}/sandbox.html")
        expect(page.frame_locator("iframe").locator("#banner")).to_contain_text("allow-same-origin")


def test_opened_as_a_file_it_says_what_to_do(browser: Browser, site: Path):
    with browser.new_context() as context:
        page = context.new_page()
        page.goto((site / "index.html").as_uri())
        expect(page.locator("#banner")).to_contain_text(f"python -m http.server -d '{site}/'")
        assert page.locator("#preview").evaluate("(image) => image.complete && image.naturalWidth") == 1200


@pytest.mark.parametrize(
    ("host", "path", "folder"),
    [
        ("", "/C:/Users/M%20E/it's/index.html", '"C:/Users/M E/it\'s/"'),
        ("", "/D:/index.html", '"D:/"'),
        ("server", "/share/toys/index.html", '"//server/share/toys/"'),
        ("", "/home/me/it's/index.html", "'/home/me/it'\\''s/'"),
        ("", "/index.html", "'/'"),
    ],
)
def test_the_command_is_one_of_the_system(page: Page, host: str, path: str, folder: str):
    served = (ROOT / "msdgs_serve" / "viewer" / "site" / "served.js").read_text()
    page.set_content("<p id='banner' hidden></p><script type='module'></script>")
    location = {"protocol": "file:", "host": host, "pathname": path}
    page.evaluate("([source, location]) => new Function('location', source)(location)", [served, location])
    assert page.locator("code").inner_text() == f"python -m http.server -d {folder}"


def test_while_it_loads_it_shows_the_preview_and_counts_bytes(page: Page, site: Path, server: str):
    held: list[Route] = []
    page.emulate_media(reduced_motion="reduce")
    page.set_viewport_size({"width": 390, "height": 844})
    page.route("**/scene.onnx.gz", lambda route: held.append(route))
    with page.expect_request("**/scene.onnx.gz"):
        page.goto(f"{server}/site/")
    expect(page.locator("#loading")).to_be_visible()
    assert page.locator("#preview").is_visible()
    preview = red(page)
    held[0].continue_()
    wait_until_still(page)
    assert preview == pytest.approx(red(page), rel=0.05), "another size than what follows"
    assert not page.locator("#loading").is_visible()

    page.unroute("**/scene.onnx.gz")
    page.goto(f"{server}/site/LICENSE.txt")
    told, stored = page.evaluate("""async () => {
        const { description, sceneFile } = await import(new URL("viewer/site/files.js", document.baseURI));
        const [scene, told] = [await description(), []];
        await sceneFile(scene, (bytes) => told.push(bytes));
        return [told, scene.file.stored]; }""")
    assert told[-1] == {"loaded": stored, "total": stored}
    assert stored == (site / "scene.onnx.gz").stat().st_size

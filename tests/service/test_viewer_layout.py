"""The page's layout: at no size does anything cover anything else, and fingers find what they touch."""

import re
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import httpx
import pytest
from playwright.sync_api import Browser, Page

from tests.service.conftest import MILLISECONDS, open_page
from tests.support.scene_files import metadata, write_scene
from tests.support.service import serving

pytestmark = pytest.mark.slow

LONG = "a scene with a name that is longer than any list or heading has room for, whatever the screen"
UNBROKEN = "x" * 100
WIDTHS = (320, 390, 600, 799, 800, 820, 821, 840, 880, 920, 960, 1000, 1099, 1101, 1280, 1920)
HEIGHTS = (320, 420, 700, 1200)

COVERED = """() => {
    const all = "button, select, input, h1, h2, p, canvas, output, dt, dd, a, svg, label, .name, .note";
    const boxes = [];
    for (const element of document.querySelectorAll(`header :is(${all}), main :is(${all}), aside :is(${all})`)) {
        if (!element.checkVisibility({ opacityProperty: true })) continue;
        let { left, top, right, bottom } = element.getBoundingClientRect();
        for (let outer = element.parentElement; outer; outer = outer.parentElement) {
            if (getComputedStyle(outer).overflow === "visible") continue;
            const seen = outer.getBoundingClientRect();
            [left, top] = [Math.max(left, seen.left), Math.max(top, seen.top)];
            [right, bottom] = [Math.min(right, seen.right), Math.min(bottom, seen.bottom)];
        }
        if (right > left && bottom > top) boxes.push({ element, left, top, right, bottom });
    }
    const named = ({ element }) => `${element.tagName} ${element.id} ${element.textContent.trim().slice(0, 20)}`;
    const wrong = boxes.filter(({ left, right }) => left < -1 || right > innerWidth + 1).map(named);
    for (const [i, a] of boxes.entries()) {
        for (const b of boxes.slice(i + 1)) {
            if (a.element.contains(b.element)) continue;
            const width = Math.min(a.right, b.right) - Math.max(a.left, b.left);
            const height = Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top);
            if (width > 1 && height > 1) wrong.push(`${named(a)} × ${named(b)}`);
        }
    }
    return wrong; }"""
"""What is outside of the page, and pairs of which neither contains the other, but that have pixels in common."""


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    """A service with scenes of long names, many cameras and many layers, one of them broken."""
    folder = tmp_path_factory.mktemp("scenes")
    cameras = tuple(replace(metadata().cameras[0], name=f"{number}, {LONG}") for number in range(30))
    layers = ("spline", "mlp", "plane") * 20
    write_scene(folder / f"{LONG}.onnx", steps=True, cameras=cameras, layers=layers, duration=12.5)
    write_scene(folder / f"{UNBROKEN}.onnx", moving=0)
    (folder / f"broken, {LONG}.onnx").write_bytes(b"")
    for number in range(20):
        write_scene(folder / f"scene_{number}.onnx")
    with serving(folder) as client:
        yield client


@pytest.mark.parametrize("touch", [False, True])
@pytest.mark.parametrize("address", [f"scene={LONG}", f"scene={UNBROKEN}&view=motion", f"scene=not {LONG}"])
def test_nothing_covers_anything(browser: Browser, client: httpx.Client, address: str, touch: bool):
    with browser.new_context(has_touch=touch, is_mobile=touch) as context:
        context.set_default_timeout(MILLISECONDS)
        page = context.new_page()
        page.goto(f"{client.base_url}/#{address}")
        page.locator("#image[data-shown=full], #banner").filter(visible=True).wait_for()
        for width in WIDTHS:
            for height in HEIGHTS:
                page.set_viewport_size({"width": width, "height": height})
                assert page.evaluate(COVERED) == [], f"{width} × {height}"


def test_a_message_covers_nothing(page: Page, client: httpx.Client):
    open_page(page, client, f"#scene={LONG}")
    page.locator("#scenes").get_by_text(f"broken, {LONG}").click()
    page.get_by_text("The scene's file is invalid").wait_for()
    for width in WIDTHS:
        page.set_viewport_size({"width": width, "height": 700})
        assert page.evaluate(COVERED) == [], width


SMALL = """(least) => [...document.querySelectorAll("button, select, input, a, .segments label")]
    .filter((element) => element.checkVisibility({ opacityProperty: true }))
    .map((element) => [element.outerHTML.slice(0, 60), element.getBoundingClientRect()])
    .filter(([, { width, height }]) => width < least || height < least).map(([name]) => name)"""


def test_fingers_find_what_they_touch(browser: Browser, client: httpx.Client):
    phone: dict[str, Any] = {"viewport": {"width": 360, "height": 740}, "has_touch": True, "is_mobile": True}
    with browser.new_context(**phone) as context:
        context.set_default_timeout(MILLISECONDS)
        page = open_page(context.new_page(), client, f"#scene={LONG}")
        assert page.evaluate(SMALL, 44) == []
        for opener in ("Help", re.compile("API key")):
            page.get_by_role("button", name=opener).click()
            assert page.evaluate(SMALL, 44) == []
            page.locator("dialog[open] button").click()
        page.set_viewport_size({"width": 740, "height": 330})
        assert (
            page.locator("#timeline").evaluate("(timeline) => timeline.getBoundingClientRect().bottom + scrollY") <= 330
        )
        page.get_by_role("button", name="Help").click()
        help_text = page.locator("#help")
        assert help_text.evaluate("(text) => text.scrollHeight > text.clientHeight && text.scrollTop") == 0


CHOSEN = """() => [
    ["#view :checked + span", "#view :not(:checked) + span"],
    ["#scenes [aria-current]", "#scenes button:not([aria-current])"],
    ["#loop", "#play"],
].map((pair) => pair.map((selector) => getComputedStyle(document.querySelector(selector)).backgroundColor))"""


def test_what_is_chosen_differs_without_the_colors_of_the_page(page: Page, client: httpx.Client):
    page.emulate_media(forced_colors="active")
    open_page(page, client, f"#scene={LONG}")
    for chosen, other in page.evaluate(CHOSEN):
        assert chosen != other

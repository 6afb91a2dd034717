"""What a site's page says if a file is missing, damaged or another one, or if the browser can't draw."""

import gzip
import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Page, expect

from tests.support.processes import forget, wait_until_still
from tests.support.scene_files import write_scene
from tests.support.sites import LOSE, LOST, NO_WEBGL2, needs_runtime, picture

pytestmark = [pytest.mark.slow, needs_runtime]

SCENE = "scene.onnx.gz"


def missing(site: Path) -> None:
    (site / SCENE).unlink()


def truncated(site: Path) -> None:
    contents = (site / SCENE).read_bytes()
    (site / SCENE).write_bytes(contents[: len(contents) // 2])


def unpacked_and_truncated(site: Path) -> None:
    contents = gzip.decompress((site / SCENE).read_bytes())
    (site / SCENE).write_bytes(contents[: len(contents) // 2])


def empty(site: Path) -> None:
    (site / SCENE).write_bytes(b"")


def a_page_instead(site: Path) -> None:
    (site / SCENE).write_text("<!doctype html><title>Not found</title>")


def another_scene(site: Path) -> None:
    (site / SCENE).write_bytes(write_scene(site.parent / "other.onnx", moving=2).read_bytes())


def same_size(site: Path) -> None:
    contents = bytearray(gzip.decompress((site / SCENE).read_bytes()))
    contents[-1] ^= 1
    (site / SCENE).write_bytes(contents)


def no_runtime(site: Path) -> None:
    shutil.rmtree(site / "onnxruntime-web")


def half_a_runtime(site: Path) -> None:
    binary = site / "onnxruntime-web" / "ort-wasm.wasm.gz"
    binary.write_bytes(binary.read_bytes()[:1000])


def another_runtime(site: Path) -> None:
    (site / "onnxruntime-web" / "ort-wasm.wasm.gz").write_bytes(b"<!doctype html>")


def no_module(site: Path) -> None:
    (site / "viewer" / "camera.js").unlink()


def no_pose_worker(site: Path) -> None:
    (site / "viewer" / "local" / "pose_worker.js").unlink()


def no_sort_worker(site: Path) -> None:
    (site / "viewer" / "local" / "sort_worker.js").unlink()


def no_description(site: Path) -> None:
    (site / "scene.json").unlink()


def half_a_description(site: Path) -> None:
    (site / "scene.json").write_text("{")


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (missing, f"The scene’s file {SCENE} can’t be loaded: the server answered 404."),
        (truncated, f"The scene’s file {SCENE} is damaged, or was not copied or sent as a whole."),
        (unpacked_and_truncated, f"The scene’s file {SCENE} ends too early"),
        (empty, f"The scene’s file {SCENE} ends too early"),
        (a_page_instead, f"The scene’s file {SCENE} isn’t a scene"),
        (another_scene, f"The scene’s file {SCENE} isn’t the one that this page was written for"),
        (same_size, f"The scene’s file {SCENE} isn’t the one that this page was written for"),
        (no_runtime, "onnxruntime-web can’t be loaded"),
        (half_a_runtime, "onnxruntime-web is damaged, or was not copied or sent as a whole."),
        (another_runtime, "onnxruntime-web can’t be used: ort-wasm.wasm.gz isn’t WebAssembly."),
        (no_module, "A file of this page is missing below viewer/"),
        (no_pose_worker, "can’t be loaded"),
        (no_sort_worker, "can’t be loaded"),
        (no_description, "The file scene.json can’t be loaded: the server answered 404."),
        (half_a_description, "The file scene.json isn’t the one that was written for this page."),
    ],
)
def test_the_page_says_what_is_wrong_with_the_folder(
    page: Page, folder: Path, site: Path, server: str, tmp_path: Path, damage: Callable[[Path], None], said: str
):
    broken = folder / tmp_path.name
    shutil.copytree(site, broken)
    damage(broken)
    page.goto(f"{server}/{broken.name}/")
    expect(page.locator("#banner")).to_contain_text(said)
    assert page.locator("#preview").is_visible()


def test_a_file_that_has_changed_underneath_is_told_as_soon_as_it_is_needed(
    page: Page, folder: Path, site: Path, server: str, tmp_path: Path
):
    changed = folder / tmp_path.name
    shutil.copytree(site, changed)
    page.emulate_media(reduced_motion="reduce")
    page.goto(f"{server}/{changed.name}/")
    wait_until_still(page)
    another_scene(changed)
    later = time.time() + 10  # for caches, which compare seconds
    os.utime(changed / SCENE, (later, later))
    page.get_by_role("button", name="Download the file").click()
    said = f"The scene’s file {SCENE} isn’t the one that this page was written for"
    expect(page.locator("#banner")).to_contain_text(said)
    forget(page)
    page.locator("#image").press("ArrowLeft")
    wait_until_still(page)

    page.evaluate(LOSE)
    expect(page.locator("#banner")).to_contain_text(LOST)
    page.evaluate("context.restoreContext()")
    expect(page.locator("#banner")).to_contain_text(said)


def test_without_webgl2_it_says_so(page: Page, site: Path, server: str):
    page.add_init_script(NO_WEBGL2)
    page.goto(f"{server}/site/")
    expect(page.locator("#banner")).to_contain_text("WebGL2")


def test_it_goes_on_after_a_lost_context(page: Page, site: Path, server: str):
    page.emulate_media(reduced_motion="reduce")
    page.goto(f"{server}/site/#t=0.5")
    wait_until_still(page)
    before = picture(page)
    page.evaluate(LOSE)
    expect(page.locator("#banner")).to_contain_text(LOST)
    forget(page)
    page.evaluate("context.restoreContext()")
    expect(page.locator("#banner")).to_be_hidden()
    wait_until_still(page)
    np.testing.assert_array_equal(picture(page), before)

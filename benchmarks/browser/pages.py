"""Pages that draw splats: ours, Spark's and PlayCanvas's, in headless Chromium."""

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from playwright.sync_api import Browser, Page

from benchmarks.browser.server import serving
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.framing import framing
from msdgs_serve.scene import Camera
from msdgs_serve.scene.camera import orbit
from tests.support.images import decode
from tests.support.processes import ROOT, WEBGL, chromium
from tests.support.sites import MODULES, RUNTIME

HERE = Path(__file__).parent
PACKAGES = HERE / "node_modules"
RENDERERS = ("msdgs", "spark", "playcanvas")
FLAGS = (
    *WEBGL,
    "--disable-frame-rate-limit",
    "--disable-gpu-vsync",
    "--enable-blink-features=ForceEagerMeasureMemory",
)
MILLISECONDS = 600_000


class Scene(NamedTuple):
    """A scene file, and its splats at one time for renderers that don't read it."""

    file: Path
    session: DeformationSession
    splats: Path | None = None


class Drawn(NamedTuple):
    """A page with a scene."""

    page: Page

    def image(self, camera: Camera, t: float) -> np.ndarray:
        """[H, W, 3] from 0 to 1."""
        self.page.evaluate("([camera, t]) => measure.still(camera, t)", [plain(camera), t])
        return decode(self.page.locator("canvas").screenshot(), "png")[0][..., :3] / 255

    def moving(self, cameras: Sequence[Camera]) -> list[dict[str, float]]:
        """Milliseconds of each frame: `all`, and `main`, on the main thread."""
        return self.page.evaluate("(cameras) => measure.moving(cameras)", [plain(camera) for camera in cameras])

    def megabytes(self) -> float:
        """Memory of the page and its workers."""
        return self.page.evaluate("() => performance.measureUserAgentSpecificMemory()")["bytes"] / 1e6


@contextlib.contextmanager
def pages(folder: Path) -> Iterator[tuple[Browser, str]]:
    """A browser, and the address of a server for the pages and the files of `folder`."""
    for fetched in (PACKAGES, MODULES):
        if not fetched.is_dir():
            name = fetched.relative_to(ROOT)
            raise SystemExit(f"no {name}: `make {name}` fetches what the pages load")
    folders = {
        "pages": HERE / "pages",
        "packages": PACKAGES,
        "runtime": RUNTIME,
        "viewer": ROOT / "msdgs_serve" / "viewer",
        "files": folder,
    }
    with serving(folders) as address, chromium(*FLAGS) as browser:
        yield browser, address


@contextlib.contextmanager
def opened(browser: Browser, address: str, renderer: str, scene: Scene, size: tuple[int, int]) -> Iterator[Drawn]:
    """A page in which a renderer shows a scene. Errors of the page are raised."""
    metadata = scene.session.scene.metadata
    options: dict[str, Any] = {
        "scene": f"/files/{scene.file.name}",
        "splats": scene.splats and f"/files/{scene.splats.name}",
        "background": metadata.background,
        "eps2d": metadata.eps2d,
        "width": size[0],
        "height": size[1],
    }
    with browser.new_context() as context:
        page = context.new_page()
        page.set_default_timeout(MILLISECONDS)
        page.goto(f"{address}/pages/index.html")
        start = "async ([name, options]) => { window.measure = await import('/pages/measure.js'); "
        page.evaluate(f"{start}await measure.open(name, options); }}", [renderer, options])
        yield Drawn(page)


def around(
    session: DeformationSession, size: tuple[int, int], azimuth: float, elevation: float, nearer: float = 1.0
) -> Camera:
    """A camera that looks at the middle of a scene, in degrees; `nearer` multiplies its distance."""
    view = framing(session.scene.metadata)
    pose = orbit(view.target, nearer * view.distance, azimuth, elevation, view.up)
    return Camera.from_fov(pose, *size, view.fov_y)


def plain(camera: Camera) -> dict[str, Any]:
    """A camera as the pages take it."""
    numbers = {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy", "width", "height")}
    return numbers | {"camera_to_world": camera.camera_to_world.tolist()}

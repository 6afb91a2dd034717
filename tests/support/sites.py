"""Sites of `msdgs-convert --site`: writing them, serving them as a plain file server does, looking at them."""

import contextlib
import functools
import threading
from collections.abc import Iterator
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Page
from rich.console import Console

from msdgs_export.exporters.command import convert
from msdgs_export.options import ConvertOptions
from msdgs_serve.browser import RUNTIME_FILES
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.framing import framing
from msdgs_serve.imaging import encode
from msdgs_serve.renderer import Renderer
from msdgs_serve.scene.camera import Camera, orbit
from tests.support.images import decode
from tests.support.processes import ROOT

MODULES = ROOT / "tests" / "export" / "runtime" / "node_modules"
RUNTIME = MODULES / "onnxruntime-web"

NO_WEBGL2 = """{
    const { prototype } = HTMLCanvasElement;
    const { getContext } = prototype;
    prototype.getContext = function (kind, ...rest) {
        return kind === "webgl2" ? null : getContext.call(this, kind, ...rest);
    };
}"""
"""Takes WebGL2 from a page."""

LOSE = """() => {
    const graphics = document.querySelector("#image + canvas").getContext("webgl2");
    window.context = graphics.getExtension("WEBGL_lose_context");
    context.loseContext();
}"""
"""Takes the graphics from a page; `context.restoreContext()` gives them back."""
LOST = "The browser has taken the graphics from this page."
"""What the page says then."""

needs_runtime = pytest.mark.skipif(
    not RUNTIME.is_dir(), reason=f"no {MODULES.relative_to(ROOT)}: `make {MODULES.relative_to(ROOT)}`"
)


def stand_in(folder: Path) -> Path:
    """A folder with the files of onnxruntime-web, which contain nothing: for what no browser opens."""
    folder.mkdir()
    for name in RUNTIME_FILES:
        (folder / name).write_bytes(b"")
    return folder


def write_site(scene: Path, out: Path, runtime: Path = RUNTIME, console: Console | None = None, **options: Any) -> Path:
    """Write the site of a scene, and return its folder."""
    chosen = ConvertOptions(scene, out, site=True, **{"onnxruntime_web": runtime, **options})
    convert(chosen, console or Console(quiet=True))
    return out


class _Quiet(SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: Any) -> None:
        """Tell nothing."""


@contextlib.contextmanager
def file_server(folder: Path) -> Iterator[str]:
    """The address of Python's file server for a folder, without a slash at its end."""
    handler = functools.partial(_Quiet, directory=str(folder))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()
        thread.join()


def picture(page: Page) -> np.ndarray:
    """The image that a site's page saves, [H, W, 3] from 0 to 1."""
    with page.expect_download() as download:
        page.get_by_role("button", name="PNG", exact=True).click()
    return decode(Path(download.value.path()).read_bytes(), "png")[0][..., :3] / 255


def drawn_by_the_service(scene: Path, t: float, azimuth: float, elevation: float, size: tuple[int, int]) -> np.ndarray:
    """What the service draws of the view of an address, [H, W, 3] from 0 to 1; the scene fills the height."""
    session = DeformationSession(scene)
    view = framing(session.scene.metadata)
    pose = orbit(view.target, view.distance, azimuth, elevation, view.up)
    camera = Camera.from_fov(pose, *size, view.fov_y)
    return decode(encode(Renderer().render(session, camera, t), "png"), "png")[0] / 255


def psnr(first: np.ndarray, second: np.ndarray) -> float:
    """PSNR in dB of two images from 0 to 1."""
    assert first.shape == second.shape
    return float(-10 * np.log10(np.mean((first - second) ** 2) + 1e-12))

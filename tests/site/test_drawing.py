"""What the browser draws equals what the service draws, for what a site's page doesn't show by itself."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser, Page

from msdgs_export.importers.scene import static_scene
from msdgs_export.importers.splats.base import Splats
from msdgs_serve.browser import RUNTIME_FILES
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.imaging.display import DepthRange, display_image
from msdgs_serve.imaging.formats import Channel
from msdgs_serve.renderer import Renderer, RenderOptions
from msdgs_serve.scene.camera import Camera, orbit
from msdgs_serve.scene.similarity import Similarity
from tests.support.pages import watched_page
from tests.support.scene_files import write_scene
from tests.support.service import serving
from tests.support.sites import RUNTIME, needs_runtime, psnr
from tests.support.splat_files import some_gaussians
from tests.support.tolerances import assert_close, tolerance

pytestmark = [pytest.mark.slow, needs_runtime]

SIZE = 120, 90
PLACE = Similarity(10.0, (3.0, -2.0, 1.0))
MANY = 20_000
"""Gaussians: several rows of each texture."""

OPEN = """async ([name, files]) => {
    const { openEngine } = await import("/viewer/local/engine.js");
    const [module, glue, binary] = files.map((file) => `/viewer/onnxruntime-web/${file}`);
    const canvas = new OffscreenCanvas(1, 1);
    const scene = `/scenes/${name}/file`;
    const onError = (error) => console.error(error.message);
    window.engine = await openEngine({ canvas, scene, runtime: { module, glue, binary }, onError });
    window.drawn = async (views) => {
        for (const view of views) engine.draw(view);
        return [...(await engine.pixels()).data];
    };
    const { gaussians, moving, steps, metadata } = engine;
    return { gaussians, moving, steps, metadata };
}"""

POSE = """([name, files, t, steps]) => new Promise((resolve, reject) => {
    const worker = new Worker("/viewer/local/pose_worker.js", { type: "module" });
    const address = (path) => String(new URL(path, location));
    const [module, glue, binary] = files.map((file) => address(`/viewer/onnxruntime-web/${file}`));
    worker.onmessage = ({ data }) => {
        if (data.kind === "failed") reject(new Error(data.message));
        if (data.kind === "opened") worker.postMessage({ kind: "pose", t, steps: steps ?? undefined, slot: 0 });
        if (data.kind !== "pose") return;
        resolve(Object.fromEntries(Object.entries(data.arrays).map(([key, array]) => [key, [...array]])));
        worker.terminate();
    };
    worker.postMessage({ kind: "open", scene: address(`/scenes/${name}/file`), runtime: { module, glue, binary } });
})"""


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scenes")
    write_scene(folder / "layers.onnx", steps=True, moving=3, scene_to_world=PLACE, eps2d=0.1)
    write_scene(folder / "chunks.onnx", steps=True, moving=5000, changing=("opacities",))
    many = static_scene(Splats(some_gaussians(MANY, 1)), "0" * 64).SerializeToString()
    (folder / "many.onnx").write_bytes(many)
    return folder


@pytest.fixture(scope="module")
def address(scenes: Path) -> Iterator[str]:
    with serving(scenes, onnxruntime_web=RUNTIME) as client:
        yield str(client.base_url)


@pytest.fixture
def opened(browser: Browser, address: str) -> Iterator[Page]:
    with watched_page(browser) as page:
        page.goto(f"{address}/viewer/icon.svg")
        yield page


def open_scene(page: Page, name: str) -> dict[str, Any]:
    return page.evaluate(OPEN, [name, list(RUNTIME_FILES.values())])


def seen(page: Page, *views: dict[str, Any]) -> np.ndarray:
    """[H, W, 3] from 0 to 1 of the last view."""
    return np.array(page.evaluate("(views) => drawn(views)", views)).reshape(*SIZE[::-1], 4)[..., :3] / 255


def plain(camera: Camera) -> dict[str, Any]:
    numbers = {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy", "width", "height")}
    return numbers | {"camera_to_world": camera.camera_to_world.tolist()}


def camera_at(target: tuple[float, ...], distance: float, azimuth: float = 40.0) -> Camera:
    return Camera.from_fov(orbit(np.array(target), distance, azimuth, 20, np.array([0.0, 0.0, 1.0])), *SIZE, 50.0)


def test_layers_channels_and_the_way_from_playing_to_rest(opened: Page, scenes: Path):
    session, renderer = DeformationSession(scenes / "layers.onnx"), Renderer()
    told = open_scene(opened, "layers")
    assert (told["gaussians"], told["moving"], told["steps"]) == (4, 3, 1)
    world = session.scene.metadata.in_world()
    np.testing.assert_allclose(told["metadata"]["bounds"], world.bounds, rtol=1e-12)
    camera = camera_at(PLACE.offset, 40.0)
    near, far = 25.0, 60.0
    views: list[tuple[dict[str, Any], RenderOptions, Channel]] = [
        ({"channel": "rgb"}, RenderOptions(), "rgb"),
        ({"steps": 0.25}, RenderOptions(steps=0.25), "rgb"),
        ({"channel": "alpha"}, RenderOptions(), "alpha"),
        ({"channel": "depth", "depthRange": [near, far]}, RenderOptions(depth=True), "depth"),
    ]
    for view, options, channel in views:
        image = renderer.render(session, camera, 0.75, options)
        wanted = display_image(image, channel, DepthRange(near, far))
        got = seen(opened, {"camera": plain(camera), "t": 0.75, **view})
        assert wanted.std() > 0.05
        assert psnr(got, np.broadcast_to(wanted, got.shape)) >= tolerance("drawn_here_db"), view
    playing = [{"camera": plain(camera), "t": t, "playing": True} for t in (0.1, 0.2, 0.3)]
    got = seen(opened, *playing, {"camera": plain(camera), "t": 0.3125})
    wanted = renderer.render(session, camera, 0.3125).display_pixels() / 255
    assert psnr(got, wanted) >= tolerance("drawn_here_db")


def test_poses_in_chunks_are_the_services(opened: Page, scenes: Path):
    session = DeformationSession(scenes / "chunks.onnx")
    for t, steps in ((0.3, None), (1.0, 0.5)):
        got = opened.evaluate(POSE, ["chunks", list(RUNTIME_FILES.values()), t, steps])
        for name, wanted in zip(("means", "quats", "scales", "opacities"), session.pose(t, steps=steps), strict=True):
            assert_close(np.reshape(got[name], wanted.shape), wanted, "read_pose")


@pytest.mark.parametrize("distance", [6.0, 0.3], ids=["outside", "inside"])
def test_many_gaussians_from_outside_and_inside(opened: Page, scenes: Path, distance: float):
    session = DeformationSession(scenes / "many.onnx")
    assert open_scene(opened, "many")["gaussians"] == MANY
    target = tuple(session.scene.static_means.mean(axis=0).tolist())
    camera = camera_at(target, distance)
    wanted = Renderer().render(session, camera, 0.0).display_pixels() / 255
    assert wanted.std() > 0.05
    assert psnr(seen(opened, {"camera": plain(camera), "t": 0.0}), wanted) >= tolerance("drawn_here_db")
    assert [Path(worker.url).name for worker in opened.workers] == ["sort_worker.js"], "nothing is posed any more"

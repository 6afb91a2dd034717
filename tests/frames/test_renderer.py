"""Rendering of a scene at a time, and the cache of its poses."""

import math
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from msdgs_serve.deformation import DeformationSession
from msdgs_serve.rasterizer import GSPLAT, rasterize
from msdgs_serve.renderer import Renderer, RenderOptions
from msdgs_serve.scene import Gaussians, InvalidInput
from msdgs_serve.scene.baked import BakedScene
from tests.support.scene_files import level_camera, metadata, write_scene

CAPPED = GSPLAT._replace(alpha_max=0.5)
POSE_BYTES = 2 * 10 * 4  # two Gaussians: means, quats, scales


@pytest.fixture(scope="module")
def session(scene: Path) -> DeformationSession:
    return DeformationSession(scene)


class CountingSession(DeformationSession):
    """A scene that records the times at which it is posed; it can be made to wait or fail."""

    def __init__(self, gaussians: Gaussians, scene: BakedScene) -> None:
        self.scene = scene
        self._gaussians = gaussians
        self.times: list[float] = []
        self.release = threading.Event()
        self.release.set()
        self.failure: Exception | None = None

    def gaussians(self, t: float, steps: float | None = None) -> Gaussians:
        self.times.append(t)
        assert self.release.wait(60)
        if self.failure:
            raise self.failure
        return self._gaussians


@pytest.fixture
def counting(session: DeformationSession) -> CountingSession:
    return CountingSession(session.gaussians(0.0), session.scene)


def test_options_and_the_scene_choose_the_rasterizer(session: DeformationSession, tmp_path: Path):
    camera, background = level_camera(24), metadata().background
    mip = DeformationSession(write_scene(tmp_path / "mip.onnx", antialiasing="mip"))
    plain = rasterize(session.gaussians(0.5), camera, background=background).rgb
    for drawn, options, rasterizer in (
        (session, RenderOptions(rasterizer=CAPPED), CAPPED),
        (mip, RenderOptions(), GSPLAT._replace(mip=True)),
    ):
        image = Renderer().render(drawn, camera, 0.5, options)
        want = rasterize(drawn.gaussians(0.5), camera, background=background, options=rasterizer)
        np.testing.assert_array_equal(image.rgb, want.rgb)
        assert np.abs(image.rgb - plain).max() > 0.001


def test_without_background_colors_are_premultiplied(session: DeformationSession):
    clear = Renderer().render(session, level_camera(), 0.5, RenderOptions("transparent"))
    opaque = Renderer().render(session, level_camera(), 0.5)
    assert clear.transparent
    over = clear.rgb + (1 - clear.alpha[..., None]) * np.array(metadata().background, np.float32)
    np.testing.assert_allclose(over, opaque.rgb, atol=1e-6)


def test_simultaneous_requests_share_one_computation(counting: CountingSession):
    renderer = Renderer()
    counting.release.clear()
    with ThreadPoolExecutor(8) as pool:
        futures = [pool.submit(renderer.posed, counting, 0.5) for _ in range(8)]
        counting.release.set()
        results = {id(future.result(60)) for future in futures}
    assert len(results) == 1
    assert counting.times == [0.5]


def test_the_least_recently_used_pose_is_evicted_first(counting: CountingSession):
    renderer = Renderer(cache_bytes=2 * POSE_BYTES)
    for t in (0.0, 0.1, 0.0, 0.2, 0.0, 0.1):  # 0.2 evicts 0.1
        renderer.posed(counting, t)
    assert counting.times == [0.0, 0.1, 0.2, 0.1]


def test_a_static_scene_takes_nothing_of_the_cache(tmp_path: Path):
    renderer, static = Renderer(), DeformationSession(write_scene(tmp_path / "static.onnx", moving=0))
    for t in (0.0, 0.5):
        assert renderer.posed(static, t).means is static.scene.static_means
    assert renderer.cache.use.poses == 0
    with pytest.raises(InvalidInput, match="in the scene's range"):
        renderer.posed(static, 2.0)


def test_scenes_do_not_share_poses(session: DeformationSession, counting: CountingSession):
    renderer, other = Renderer(), CountingSession(session.gaussians(1.0), session.scene)
    assert renderer.posed(counting, 0.0) is not renderer.posed(other, 0.0)


def test_a_failed_computation_fails_all_requests_and_is_repeated(counting: CountingSession):
    renderer = Renderer()
    counting.failure = RuntimeError("no memory")
    counting.release.clear()
    with ThreadPoolExecutor(4) as pool:
        futures = [pool.submit(renderer.posed, counting, 0.5) for _ in range(4)]
        while not counting.times:
            pass
        counting.release.set()
        assert all(str(future.exception(10)) == "no memory" for future in futures)
    counting.failure = None
    assert len(renderer.posed(counting, 0.5)) == 2


def test_a_negative_capacity_is_refused():
    with pytest.raises(InvalidInput) as error:
        Renderer(cache_bytes=-1)
    assert error.value.field == "cache_bytes"


def test_options_are_taken_as_arrays_and_refused_by_name(session: DeformationSession):
    white: Any = np.ones(3)
    ones: Any = [1, 1, 1]
    assert RenderOptions(white) == RenderOptions(ones) == RenderOptions((1.0, 1.0, 1.0))
    assert Renderer().render(session, level_camera(), 0.0, RenderOptions(white)).rgb.max() <= 1
    for name, value in (
        ("background", (255, 255, 255)),
        ("background", "white"),
        ("background", 1.0),
        ("background", (math.nan, 0, 0)),
        ("region", (0, 0, 8, 8)),
        ("shutter", (0, 0.1)),
    ):
        given: Any = {name: value}
        with pytest.raises(InvalidInput, match=f"`{name}`"):
            RenderOptions(**given)

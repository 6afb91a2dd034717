"""Rendering of a scene at a time, and the cache of its poses."""

import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from msdgs_serve.deformation import DeformationSession
from msdgs_serve.rasterizer import GSPLAT, INRIA, rasterize
from msdgs_serve.renderer import Renderer, RenderOptions
from msdgs_serve.scene import Camera, Gaussians, InvalidInput
from msdgs_serve.scene.baked import BakedScene
from msdgs_serve.scene.camera import orbit
from tests.support.scene_files import UP, metadata, write_scene

SIZE = 64
BLUE = (0.1, 0.2, 0.3)
POSE_BYTES = 2 * 10 * 4  # two Gaussians: means, quats, scales


@pytest.fixture(scope="module")
def session(scene: Path) -> DeformationSession:
    return DeformationSession(scene)


def level_camera(width: int = SIZE, height: int = SIZE) -> Camera:
    """Return a camera five units away, at the height of the origin; z is up."""
    return Camera.from_fov(orbit(np.zeros(3), 5.0, 0, 0, UP), width, height, 40.0)


class CountingSession(DeformationSession):
    """A scene that records the times at which it is posed, and that can wait or fail."""

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


@pytest.mark.parametrize(("t", "row"), [(0.0, "below"), (1.0, "above")])
def test_the_frame_shows_the_scene_at_its_time(session: DeformationSession, t: float, row: str):
    image = Renderer().render(session, level_camera(), t, RenderOptions(depth=True))
    middle = SIZE // 2
    assert image.rgb[middle, middle].argmax() == 0, "the red ball rests in the middle"
    greens = np.argwhere(image.rgb[..., 1] > 0.8)
    assert len(greens) > 10
    assert (greens[:, 0] > middle).all() if row == "below" else (greens[:, 0] < middle).all()
    np.testing.assert_allclose(image.rgb[0, 0], metadata().background, atol=1e-6)
    assert image.alpha[0, 0] == 0
    assert image.depth is not None
    assert np.isinf(image.depth[0, 0])
    assert abs(image.depth[middle, middle] - 5) < 1e-3


def test_the_image_is_what_the_rasterizer_draws(session: DeformationSession):
    image = Renderer().render(session, level_camera(), 0.3, RenderOptions(BLUE, depth=True, rasterizer=INRIA))
    drawn = rasterize(session.gaussians(0.3), level_camera(), background=BLUE, depth=True, options=INRIA)
    np.testing.assert_array_equal(image.rgb, drawn.rgb)
    np.testing.assert_array_equal(image.alpha, drawn.alpha)
    np.testing.assert_array_equal(image.depth, drawn.depth)  # pyright: ignore[reportArgumentType]
    assert not image.transparent


def test_a_scene_says_how_it_is_antialiased(tmp_path: Path):
    session = DeformationSession(write_scene(tmp_path / "mip.onnx", antialiasing="mip"))
    camera = level_camera(24, 24)
    image = Renderer().render(session, camera, 0.5)
    background, gaussians = metadata().background, session.gaussians(0.5)
    want = rasterize(gaussians, camera, background=background, options=GSPLAT._replace(mip=True))
    np.testing.assert_array_equal(image.rgb, want.rgb)
    assert np.abs(image.rgb - rasterize(gaussians, camera, background=background).rgb).max() > 0.001


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


def test_the_pose_asked_for_longest_ago_is_forgotten_first(counting: CountingSession):
    renderer = Renderer(cache_bytes=2 * POSE_BYTES)
    for t in (0.0, 0.1, 0.0, 0.2, 0.0, 0.1):  # 0.2 drives out 0.1
        renderer.posed(counting, t)
    assert counting.times == [0.0, 0.1, 0.2, 0.1]


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


def test_eight_threads_get_the_bytes_that_one_gets(session: DeformationSession):
    sizes = [(17 + 13 * i, 80 - 7 * i) for i in range(8)]

    def draw(renderer: Renderer, number: int) -> bytes:
        image = renderer.render(session, level_camera(*sizes[number]), number % 3 / 2, RenderOptions(depth=True))
        assert image.depth is not None
        return image.rgb.tobytes() + image.alpha.tobytes() + image.depth.tobytes()

    alone = [draw(Renderer(), number) for number in range(8)]
    shared = Renderer(cache_bytes=2 * POSE_BYTES)
    with ThreadPoolExecutor(8) as pool:
        together = list(pool.map(lambda number: draw(shared, number % 8), range(32)))
    assert together == alone * 4


def test_a_cache_of_less_than_nothing_is_refused():
    with pytest.raises(InvalidInput) as error:
        Renderer(cache_bytes=-1)
    assert error.value.field == "cache_bytes"

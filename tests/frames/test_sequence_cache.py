"""What cameras that stand still keep: frames are the same, memory is bounded, threads don't disturb each other."""

import gc
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from msdgs_serve import sequence_cache
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.imaging import Image
from msdgs_serve.rasterizer import TooManyPairs
from msdgs_serve.renderer import Renderer, RenderOptions, Shutter
from msdgs_serve.scene import Camera, InvalidInput, Region
from tests.support.scene_files import level_camera, write_scene

TIMES = np.linspace(0, 1, 7).tolist()


@pytest.fixture(scope="module")
def session(scene: Path) -> DeformationSession:
    return DeformationSession(scene)


def assert_same(got: Image, want: Image):
    for name in ("rgb", "alpha", "depth", "motion", "gaussians"):
        np.testing.assert_array_equal(getattr(got, name), getattr(want, name))


@pytest.mark.parametrize(
    "options",
    [
        RenderOptions(),
        RenderOptions("transparent", depth=True),
        RenderOptions((0.1, 0.5, 0.9), region=Region(20, 3, 30, 50)),
        RenderOptions(shutter=Shutter(0.0, 0.1, 3)),
    ],
    ids=["plain", "depth", "region", "shutter"],
)
def test_frames_are_the_same(session: DeformationSession, options: RenderOptions):
    renderer, fresh, camera = Renderer(), Renderer(sequence_bytes=0), level_camera()
    times = TIMES[:-1] if options.shutter else TIMES
    for t in times:
        assert_same(renderer.render(session, camera, t, options), fresh.render(session, camera, t, options))
    use = renderer.sequences.use
    samples = options.shutter.samples if options.shutter else 1
    assert (use.sequences, use.drawn, use.whole) == (1, samples * len(times) - 1, 1)
    assert fresh.sequences.use.drawn == 0


@pytest.mark.parametrize(
    "options", [RenderOptions(motion_dt=0.1), RenderOptions(counts=True)], ids=["motion", "counts"]
)
def test_channels_of_whole_frames(session: DeformationSession, options: RenderOptions):
    renderer = Renderer()
    for t in TIMES[:3]:
        renderer.render(session, level_camera(), t, options)
    assert renderer.sequences.use.drawn == 0


def test_views_that_differ_are_not_mixed_up(session: DeformationSession, tmp_path: Path):
    camera = level_camera()
    turned = replace(camera, camera_to_world=camera.camera_to_world @ np.diag([-1.0, -1.0, 1.0, 1.0]))
    other = DeformationSession(write_scene(tmp_path / "other.onnx", static_color=(0.0, 0.0, 1.0)))
    renderer, fresh = Renderer(), Renderer(sequence_bytes=0)
    views: list[tuple[DeformationSession, Camera, RenderOptions]] = [
        (session, camera, RenderOptions()),
        (session, camera, RenderOptions((1.0, 1.0, 1.0))),
        (session, camera, RenderOptions(depth=True)),
        (session, camera, RenderOptions(region=Region(0, 0, 40, 40))),
        (session, replace(camera, fx=70.0), RenderOptions()),
        (session, turned, RenderOptions()),
        (other, camera, RenderOptions()),
    ]
    for t in TIMES[:3]:
        for view in views:
            assert_same(renderer.render(view[0], view[1], t, view[2]), fresh.render(view[0], view[1], t, view[2]))
    assert renderer.sequences.use.sequences == len(views)


def test_memory_is_bounded(session: DeformationSession):
    """The least recently used camera goes; a sequence that is too large alone is not kept."""
    camera = level_camera()
    renderer = Renderer()
    for t in TIMES[:2]:
        renderer.render(session, camera, t)
    size = renderer.sequences.use.bytes
    renderer, cameras = Renderer(sequence_bytes=2 * size), [replace(camera, cx=camera.cx + k) for k in range(3)]
    for one in cameras:
        for t in TIMES[:2]:
            renderer.render(session, one, t)
    assert (renderer.sequences.use.sequences, renderer.sequences.use.bytes) == (2, 2 * size)
    drawn = renderer.sequences.use.drawn
    renderer.render(session, cameras[0], 0.5)
    assert renderer.sequences.use.drawn == drawn
    renderer.render(session, cameras[2], 0.5)
    assert renderer.sequences.use.drawn == drawn + 1
    small = Renderer(sequence_bytes=size - 1)
    for t in TIMES:
        assert_same(small.render(session, camera, t), Renderer().render(session, camera, t))
    assert small.sequences.use.bytes == 0
    with pytest.raises(InvalidInput, match="sequence_bytes"):
        Renderer(sequence_bytes=-1)


def test_a_replaced_scene_is_not_kept_alive(scene: Path):
    renderer, camera = Renderer(), level_camera()
    first = DeformationSession(scene)
    for t in TIMES[:2]:
        renderer.render(first, camera, t)
    del first
    gc.collect()
    second = DeformationSession(scene)
    for t in TIMES[:2]:
        renderer.render(second, camera, t)
    assert renderer.sequences.use.sequences == 1


def test_threads_get_their_own_frames(session: DeformationSession):
    renderer, fresh, camera = Renderer(), Renderer(sequence_bytes=0), level_camera()
    expected = {t: fresh.render(session, camera, t) for t in TIMES}
    with ThreadPoolExecutor(4) as pool:
        asked = [TIMES[k % len(TIMES)] for k in range(60)]
        frames = list(pool.map(lambda t: renderer.render(session, camera, t), asked))
    for t, image in zip(asked, frames, strict=True):
        assert_same(image, expected[t])


def test_cameras_are_remembered_up_to_a_number(session: DeformationSession, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sequence_cache, "REMEMBERED_CAMERAS", 4)
    renderer, camera = Renderer(), level_camera(16)
    cameras = [replace(camera, cx=camera.cx + k) for k in range(5)]
    for count, drawn in ((3, 3), (5, 0)):
        renderer = Renderer()
        for t in TIMES[:2]:
            for one in cameras[:count]:
                renderer.render(session, one, t)
        assert renderer.sequences.use.drawn == drawn


def test_what_can_only_be_drawn_in_parts_is_tried_once(session: DeformationSession, monkeypatch: pytest.MonkeyPatch):
    tried = []

    def too_many(*_: Any, **__: Any) -> None:
        tried.append(1)
        raise TooManyPairs

    monkeypatch.setattr(sequence_cache, "FrameSequence", too_many)
    monkeypatch.setattr(sequence_cache, "_least_bytes", lambda *_: 0)
    renderer, camera = Renderer(), level_camera(16)
    for t in TIMES:
        assert_same(renderer.render(session, camera, t), Renderer(sequence_bytes=0).render(session, camera, t))
    assert len(tried) == 1

"""The Python client against a real service."""

from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest

from msdgs_serve.client import Client, LookAt, Matrix, Orbit, Problem, SceneCamera, Shutter, Unreachable, request_body
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.imaging.encode import npy
from msdgs_serve.scene.camera import OPENGL_TO_OPENCV
from tests.support.images import decode
from tests.support.scene_files import UP, level_camera, metadata, write_scene
from tests.support.scenes import draw
from tests.support.service import serving

SIZE = 48
LEVEL = Orbit(0, 0, distance=5, fov_y=40)


@pytest.fixture(scope="module")
def url(scene: Path) -> Iterator[str]:
    with serving(scene) as client:
        yield str(client.base_url)


@pytest.fixture(scope="module")
def client(url: str) -> Iterator[Client]:
    with Client(url) as client:
        yield client


def test_frames_are_arrays_as_drawn(client: Client, scene: Path):
    frame = client.render(LEVEL, 0.3, width=SIZE, height=SIZE, background="scene")
    drawn = draw(DeformationSession(scene).gaussians(0.3), level_camera(SIZE), background=metadata().background)
    for name in ("rgb", "alpha", "depth"):
        np.testing.assert_array_equal(getattr(frame, name), getattr(drawn, name))
    assert frame.plan == "network"
    assert {"queue", "pose", "draw", "encode"} == set(frame.milliseconds)


def test_every_kind_of_camera(client: Client):
    pose, focal = level_camera().camera_to_world, SIZE / 2 / np.tan(np.radians(20))
    expected = client.render(LEVEL, 0.0, width=SIZE, height=SIZE).rgb
    cameras = [
        LookAt(pose[:3, 3], [0, 0, 0], UP, 40),  # pyright: ignore[reportArgumentType]
        Matrix(pose, fov_y=40),
        Matrix(pose, fx=focal, fy=focal, cx=SIZE / 2, cy=SIZE / 2),
        Matrix(pose @ OPENGL_TO_OPENCV, "opengl", fx=focal),
        Matrix(pose, fx=focal, model="fisheye", distortion=[1 / 3, 2 / 15, 17 / 315, 62 / 2835]),  # of the tangent
    ]
    for camera in cameras:
        rgb = client.render(camera, 0.0, width=SIZE, height=SIZE).rgb
        np.testing.assert_allclose(rgb, expected, atol=1e-4)  # pyright: ignore[reportArgumentType, reportCallIssue]
    named = client.render(SceneCamera(name="view_0"), 0.0, channels=("depth", "rgb"))
    assert named.alpha is None
    assert [part.shape for part in (named.rgb, named.depth) if part is not None] == [(48, 64, 3), (48, 64)]


def test_files_and_blur(client: Client):
    file = client.render_file(LEVEL, 0.5, format="webp", quality=80, width=SIZE, height=SIZE)
    assert decode(file, "webp")[0].shape == (SIZE, SIZE, 3)
    sharp = client.render(LEVEL, 0.5, width=SIZE, height=SIZE).alpha
    soft = client.render(LEVEL, 0.5, width=SIZE, height=SIZE, shutter=Shutter(-0.3, 0.3)).alpha
    assert sharp is not None
    assert soft is not None
    assert soft.max() < sharp.max() or (soft > 0).sum() > (sharp > 0).sum()


def test_many_frames_and_one_that_fails(client: Client):
    bodies = [request_body(LEVEL, t, width=SIZE, height=SIZE) for t in (0.0, 7.0, 1.0)]
    answers = dict(client.render_many(bodies))
    assert answers[0] == client.render_file(LEVEL, 0.0, width=SIZE, height=SIZE)
    failed = answers[1]
    assert isinstance(failed, Problem)
    assert (failed.status, list(failed.errors)) == (422, ["t"])
    with pytest.raises(Problem, match="frames"):
        list(client.render_many([]))
    with pytest.raises(Problem, match="no scene `nothing`"):
        client.scene("nothing")


def test_scenes_are_listed_added_and_deleted(tmp_path: Path):
    (tmp_path / "scenes").mkdir()
    file = write_scene(tmp_path / "walk.onnx")
    with serving(tmp_path / "scenes", uploads=True) as http, Client(str(http.base_url)) as client:
        assert client.ready()
        sha256 = client.add_scene("a walk, öffentlich?", file)
        assert client.scenes() == ["a walk, öffentlich?"]
        assert client.scene("a walk, öffentlich?")["sha256"] == sha256
        client.delete_scene("a walk, öffentlich?")
        assert client.scenes() == []


def test_keys_are_sent(scene: Path, tmp_path: Path):
    (tmp_path / "keys").write_text("read 0123456789abcdef")
    with serving(scene, api_keys_file=tmp_path / "keys") as http:
        with Client(str(http.base_url)) as client, pytest.raises(Problem) as error:
            client.scenes()
        assert error.value.status == 401
        with Client(str(http.base_url), api_key="0123456789abcdef") as client:
            assert client.scenes() == ["balls"]


def test_an_unreachable_service():
    with Client("http://127.0.0.1:9", seconds=1) as client:
        assert not client.ready()
        with pytest.raises(Unreachable, match=r"127\.0\.0\.1:9"):
            client.scenes()
        with pytest.raises(Unreachable, match=r"127\.0\.0\.1:9"):
            list(client.render_many([request_body(LEVEL, 0.0)]))


def test_answers_of_proxies_are_understood():
    timing = 'cache;desc=hit, edge; dur=3, pose;dur=1.25;desc="cached", draw;desc="a b";dur="7."'
    pixels = npy(np.zeros((2, 2, 1), np.float32))
    answers = iter([
        httpx.Response(200, headers={"Server-Timing": timing}, content=pixels),
        httpx.Response(503, headers={"Retry-After": "Wed, 21 Oct 2015 07:28:00 GMT"}),
    ])  # fmt: skip
    with Client(transport=httpx.MockTransport(lambda _: next(answers)), tries=0) as client:
        frame = client.render(LEVEL, 0.0, channels=("alpha",))
        assert frame.milliseconds == {"edge": 3, "pose": 1.25, "draw": 7}
        with pytest.raises(Problem, match="503"):
            client.scenes()


def test_an_overloaded_service_is_asked_again():
    calls = []

    def answer(_: httpx.Request) -> httpx.Response:
        calls.append(1)
        if len(calls) < 3:
            return httpx.Response(503, headers={"Retry-After": "0"}, json={"detail": "later", "errors": []})
        return httpx.Response(200, json={"scenes": []})

    with Client(transport=httpx.MockTransport(answer)) as client:
        assert client.scenes() == []
    assert len(calls) == 3
    calls.clear()
    with Client(transport=httpx.MockTransport(answer), tries=2) as client, pytest.raises(Problem, match="503: later"):
        client.scenes()

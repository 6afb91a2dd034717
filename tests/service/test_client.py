"""The Python client against a real service."""

import json
import re
from collections.abc import Callable, Iterator
from decimal import Decimal
from fractions import Fraction
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from msdgs_serve.client import (
    WIDTHS,
    Client,
    ClientError,
    LookAt,
    Matrix,
    Orbit,
    Problem,
    SceneCamera,
    Shutter,
    Unreachable,
    request_body,
)
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.imaging.encode import npy
from msdgs_serve.scene.camera import OPENGL_TO_OPENCV
from tests.support.images import decode
from tests.support.scene_files import UP, level_camera, metadata, write_scene
from tests.support.scenes import draw
from tests.support.service import serving

SIZE = 48
LEVEL = Orbit(0, 0, distance=5, fov_y=40)

PATIENCE = 600.0
"""Seconds; the first frame waits for kernels to compile."""


@pytest.fixture(scope="module")
def url(scene: Path) -> Iterator[str]:
    with serving(scene) as client:
        yield str(client.base_url)


@pytest.fixture(scope="module")
def client(url: str) -> Iterator[Client]:
    with Client(url, seconds=PATIENCE) as client:
        yield client


def test_frames_are_arrays_as_drawn(client: Client, scene: Path):
    frame = client.render(LEVEL, 0.3, width=SIZE, height=SIZE, background="scene")
    drawn = draw(DeformationSession(scene).gaussians(0.3), level_camera(SIZE), background=metadata().background)
    for name in ("rgb", "alpha", "depth"):
        np.testing.assert_array_equal(getattr(frame, name), getattr(drawn, name))
    assert frame.plan == "network"
    assert {"queue", "pose", "draw", "encode"} == set(frame.milliseconds)


def test_a_region_of_a_frame(client: Client):
    whole = client.render(LEVEL, 0.3, width=SIZE, height=SIZE)
    part = client.render(LEVEL, 0.3, width=SIZE, height=SIZE, region=(5, 7, np.int64(20), 9))
    assert part.rgb is not None
    assert whole.rgb is not None
    np.testing.assert_array_equal(part.rgb, whole.rgb[7:16, 5:25])


def test_every_kind_of_camera(client: Client):
    pose, focal = level_camera().camera_to_world, SIZE / 2 / np.tan(np.radians(20))
    expected = client.render(LEVEL, 0.0, width=SIZE, height=SIZE).rgb
    cameras = [
        LookAt(pose[:3, 3], [0, 0, 0], UP, 40),
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


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64, np.longdouble, np.int8, np.uint64])
def test_numbers_of_numpy_are_those_of_python(client: Client, dtype: type):
    expected = client.render(Orbit(20, 10, 5, (0, 0, 0), (0, 0, 1), 40), 1, width=16, height=12, steps=None)
    elevation: Any = np.array(10, dtype)
    up: list[Any] = [dtype(0), np.array(0, dtype), dtype(1)]
    camera = Orbit(dtype(20), elevation, dtype(5), np.zeros(3, dtype), up, dtype(40))
    for t in (dtype(1), np.array(1, dtype), Fraction(1), Decimal("1.0")):
        frame = client.render(camera, t, width=np.int64(16), height=np.array(12, np.uint8), scene=np.str_("balls"))  # pyright: ignore[reportArgumentType]
        np.testing.assert_array_equal(frame.rgb, expected.rgb)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64, np.longdouble, np.int8, np.uint64])
def test_every_field_of_a_body_may_be_of_numpy(client: Client, dtype: type):
    one, vector = dtype(1), np.array([0, 0, 4], dtype)
    camera = Matrix(
        np.eye(4, dtype=dtype), fx=one, fy=one, cx=one, cy=one, model="fisheye", distortion=np.zeros(4, dtype)
    )
    channels: Any = np.array(["rgb", "motion"])
    body = request_body(
        camera, one, width=np.int16(16), height=np.int32(12), quality=np.uint8(7), background=(one, dtype(0), one),
        shutter=Shutter(dtype(0), one, np.int8(3)), dt=one, steps=one, channels=channels,
    )  # fmt: skip
    plain = {
        "camera": {
            "type": "matrix", "camera_to_world": np.eye(4).tolist(), "axes": "opencv", "fx": 1, "fy": 1, "cx": 1,
            "cy": 1, "model": "fisheye", "distortion": [0, 0, 0, 0],
        },
        "t": 1, "width": 16, "height": 12, "format": "png", "quality": 7, "channels": ["rgb", "motion"],
        "background": [1, 0, 1], "dt": 1, "steps": 1, "shutter": {"open": 0, "close": 1, "samples": 3},
    }  # fmt: skip
    assert json.loads(json.dumps(body)) == plain
    seen = client.render(LookAt(vector, vector * 0, np.array([0, 1, 0], dtype), dtype(40)), one, width=16, height=12)
    by_python = client.render(LookAt([0, 0, 4], [0, 0, 0], [0, 1, 0], 40), 1, width=16, height=12)
    np.testing.assert_array_equal(seen.rgb, by_python.rgb)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    "times", [[0.0, 0.5, 1.0], (0, 0.5, 1), np.linspace(0, 1, 3), np.linspace(0, 1, 3, dtype="f4")]
)
def test_a_list_of_times_gives_arrays_of_as_many_frames(client: Client, times: Any):
    several = client.render(LEVEL, times, width=16, height=12, channels=tuple(WIDTHS), dt=0.0)
    assert several.rgb is not None
    assert several.rgb.shape == (3, 12, 16, 3)
    for number, t in enumerate((0.0, 0.5, 1.0)):
        alone = client.render(LEVEL, t, width=16, height=12, channels=tuple(WIDTHS), dt=0.0)
        for name in WIDTHS:
            np.testing.assert_array_equal(getattr(several, name)[number], getattr(alone, name))
    one = client.render(LEVEL, times[:1], width=16, height=12).depth
    assert one is not None
    assert one.shape == (1, 12, 16)
    with pytest.raises(Problem, match="POST /render/batch"):
        client.render_file(LEVEL, times, width=16, height=12)


NO_NUMBERS = [
    float("nan"), -float("inf"), np.float32("nan"), np.array(np.inf), [0.0, np.nan], np.array([0.0, -np.inf]), 1j,
    np.complex64(1), np.datetime64("2026-01-01"), object(), {0.5}, b"0.5", (t for t in [0.5]), 10**5000,
    [None, object()], np.longdouble("1e400"), Decimal("NaN"), np.ma.masked, np.array([object()]), [[0.5], {1}],
]  # fmt: skip


@pytest.mark.parametrize("value", NO_NUMBERS, ids=lambda value: type(value).__name__)
def test_what_is_no_number_is_refused_by_name(client: Client, value: Any):
    calls: list[tuple[str, Callable[[], object]]] = [
        ("t", lambda: client.render(LEVEL, value)),
        ("width", lambda: client.render(LEVEL, 0.5, width=value)),
        ("background", lambda: client.render_file(LEVEL, 0.5, background=value)),
        ("camera.azimuth", lambda: client.render(Orbit(value, 0), 0.5)),
        ("camera.camera_to_world", lambda: client.render(Matrix(value, fov_y=40), 0.5)),
        ("shutter.open", lambda: client.render(LEVEL, 0.5, shutter=Shutter(value, 1))),
        ("frames.1.t", lambda: list(client.render_many([request_body(LEVEL, 0.5), {"t": value}]))),
    ]
    for name, call in calls:
        with pytest.raises(ClientError, match=rf"^`{re.escape(name)}[.\d]*` must be a finite number") as error:
            call()
        assert not isinstance(error.value, Problem)


@pytest.mark.parametrize(
    ("t", "width"),
    [("0.5", 16), (np.bool_(True), 16), (0.5, np.float64(16.5)), (0.5, True), (0.5, 2**70), ([], 16), ([[0.5]], 16),
     (np.array([]), 16), (np.zeros((1, 1)), 16), (2.0, 16), (0.5, [16]), (0.5, "16")],
)  # fmt: skip
def test_values_that_the_service_refuses_are_problems(client: Client, t: Any, width: Any):
    with pytest.raises(Problem, match="422"):
        client.render(LEVEL, t, width=width, height=12)


def test_names_that_utf8_cannot_hold_are_refused(client: Client):
    with pytest.raises(ClientError, match="`scene` must be text"):
        client.render(LEVEL, 0.5, scene="\udce9")


@pytest.mark.parametrize(
    ("arguments", "problem"), [({"url": "http://[::1"}, "::1"), ({"api_key": "schlüssel"}, "ASCII")]
)
def test_a_url_or_key_that_cannot_be_sent_is_named(arguments: dict[str, Any], problem: str):
    with pytest.raises(ClientError, match=problem):
        Client(**arguments)


def test_a_background_of_null_stays_in_a_body(client: Client):
    bodies: list[dict[str, Any]] = [{**request_body(LEVEL, 0.5, width=8, height=8), "background": None}]
    assert dict(client.render_many(bodies))[0] == client.render_file(
        LEVEL, 0.5, width=8, height=8, background="transparent"
    )


@pytest.mark.parametrize("content", [b"", b"<html>", npy(np.zeros((2, 2, 5), np.float32))[:100], b"PK\x03\x04"])
def test_an_answer_of_another_service_is_named(content: bytes):
    answer = httpx.Response(200, headers={"Content-Type": "text/html"}, content=content)
    with (
        Client(transport=httpx.MockTransport(lambda _: answer)) as client,
        pytest.raises(ClientError, match="not an answer of the service, but text/html"),
    ):
        client.render(LEVEL, 0.5)


CALLS: dict[str, Callable[[Client], object]] = {
    "render": lambda client: client.render(LEVEL, 0.5),
    "render_file": lambda client: client.render_file(LEVEL, 0.5),
    "render_many": lambda client: list(client.render_many([request_body(LEVEL, 0.5)])),
    "scenes": Client.scenes,
    "scene": lambda client: client.scene("a"),
    "add_scene": lambda client: client.add_scene("a", Path(__file__)),
    "delete_scene": lambda client: client.delete_scene("a"),
}


@pytest.mark.parametrize("call", CALLS.values(), ids=CALLS)
def test_a_redirect_is_a_problem(call: Callable[[Client], object]):
    answer = httpx.Response(301, headers={"Location": "https://elsewhere/"}, html="<html>")
    with (
        Client(transport=httpx.MockTransport(lambda _: answer)) as client,
        pytest.raises(Problem, match="301: Moved Permanently to https://elsewhere/"),
    ):
        call(client)


@pytest.mark.parametrize("text", ["<html>", "[]", "[1]", "null", "1"])
@pytest.mark.parametrize("name", CALLS)
def test_other_text_is_no_answer_of_the_service(name: str, text: str):
    answer = httpx.Response(200, headers={"Content-Type": "text/plain"}, text=text)
    with (
        Client(transport=httpx.MockTransport(lambda _: answer)) as client,
        pytest.raises(ClientError, match="not an answer of the service, but text/plain"),
    ):
        CALLS[name](client)


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
    with serving(tmp_path / "scenes", uploads=True) as http, Client(str(http.base_url), seconds=PATIENCE) as client:
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

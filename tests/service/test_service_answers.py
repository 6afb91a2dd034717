"""Channels and motion blur of frames, and the rest of their responses: versions, timings, ids, metrics."""

import json
import logging
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from msdgs_serve.api.errors import REMOVED
from msdgs_serve.api.observe import JsonLines, request_id
from msdgs_serve.imaging.display import FARTHEST_BRIGHTNESS
from msdgs_serve.imaging.image import linear_to_srgb, srgb_to_linear
from tests.support.images import decode
from tests.support.scene_files import metadata, write_scene
from tests.support.service import ORBIT, check_problem, eventually, in_this_process, serving

SIZE = 48
FRAME = {"camera": {**ORBIT, "distance": 5, "fov_y": 40}, "t": 0.5, "width": SIZE, "height": SIZE}
FILM_FRAME = {"camera": ORBIT, "t": 0.5}
PIXELS = {"type": "matrix", "camera_to_world": np.eye(4).tolist(), "fx": 9}


@pytest.fixture(scope="module")
def client(scene: Path) -> Iterator[httpx.Client]:
    with serving(scene, max_samples=16, max_batch=8, max_video_frames=3) as client:
        yield client


def post(client: httpx.Client, **changes: Any) -> httpx.Response:
    return client.post("/render", json={**FRAME, **changes})


def array(client: httpx.Client, **changes: Any) -> np.ndarray:
    response = post(client, format="npy", **changes)
    assert response.status_code == 200, response.text
    return decode(response.content, "npy")[0]


def test_a_frame_that_the_client_has_is_not_sent_again(client: httpx.Client):
    first = post(client)
    tag = first.headers["ETag"]
    for value in (tag, f'"other", {tag}', f"W/{tag}", "*"):
        again = client.post("/render", json=FRAME, headers={"If-None-Match": value})
        assert (again.status_code, again.content, again.headers["ETag"]) == (304, b"", tag)
    changed = client.post("/render", json={**FRAME, "t": 0.25}, headers={"If-None-Match": tag})
    assert changed.status_code == 200
    assert changed.headers["ETag"] != tag


def test_another_file_is_another_version(tmp_path: Path):
    path = write_scene(tmp_path / "balls.onnx")
    with serving(tmp_path) as client:
        before = post(client).headers["ETag"]
        write_scene(path, static_color=(0, 0, 1))
        eventually(lambda: post(client).headers["ETag"] != before)


def test_headers_name_plan_channels_and_stages(client: httpx.Client):
    post(client, t=0.123)
    response = post(client, t=0.123, channels=["depth"])
    stages = dict(re.findall(r"(\w+);dur=([\d.]+)", response.headers["Server-Timing"]))
    assert set(stages) == {"queue", "pose", "draw", "encode"}
    assert all(float(value) >= 0 for value in stages.values())
    assert "pose;dur=" in response.headers["Server-Timing"]
    assert 'desc="hit"' in response.headers["Server-Timing"]
    assert response.headers["Msdgs-Plan"] == metadata().plan
    assert response.headers["Msdgs-Channels"] == "depth"
    assert response.headers["Msdgs-Scene"] == "balls"


def test_the_measured_error_of_a_file_is_a_header(tmp_path: Path):
    write_scene(tmp_path / "walk.onnx", measured_error={"rendered": {"psnr_worst": 60}})
    write_scene(tmp_path / "plain.onnx")
    with serving(tmp_path) as client:
        assert post(client, scene="walk").headers["Msdgs-Error"] == "60.00"
        assert "Msdgs-Error" not in post(client, scene="plain").headers


def test_a_removed_field_is_refused_with_what_replaces_it(client: httpx.Client):
    batch = {"frames": [{**FRAME, "min_psnr": 40}]}
    (line,) = client.post("/render/batch", json=batch).text.splitlines()
    answers = [post(client, min_psnr=40), client.get("/render?min_psnr=40")]
    for problem in (json.loads(line)["problem"], *(answer.json() for answer in answers)):
        assert problem["status"] == 422
        assert problem["errors"] == [{"field": "min_psnr", "message": REMOVED["min_psnr"]}]


def test_get_equals_post(client: httpx.Client):
    link = f"/render?azimuth=0&elevation=0&distance=5&fov_y=40&t=0.5&width={SIZE}&height={SIZE}"
    response = client.get(link)
    assert response.content == post(client).content
    assert response.headers["ETag"] == post(client).headers["ETag"]
    assert response.headers["Cache-Control"] == "no-cache"
    assert client.get(link, headers={"If-None-Match": response.headers["ETag"]}).status_code == 304
    assert client.get("/render").status_code == 200
    motion = client.get(f"{link}&channels=motion&dt=0.2&format=npy")
    assert motion.content == post(client, channels=["motion"], dt=0.2, format="npy").content
    look_at = client.get(f"/render?eye=5,0,0&target=0,0,0&up=0,0,1&fov_y=40&width={SIZE}&height={SIZE}&t=0.5")
    assert look_at.status_code == 200
    named = client.get("/render?camera=view_90&background=1,0,0&channels=rgb&format=webp&quality=80")
    assert decode(named.content, "webp")[0].shape == (48, 64, 3)


@pytest.mark.parametrize(
    ("query", "field"),
    [
        ("t=nan", "t"),
        ("t=2", "t"),
        ("width=0", "width"),
        ("eye=1,2", "eye"),
        ("eye=a,b,c", "eye"),
        ("camera=view_0&azimuth=3", "azimuth"),
        ("background=blue", "background"),
        ("channels=smell", "channels"),
        ("surprise=1", "surprise"),
        ("elevation=90", "elevation"),
        ("index=99", "index"),
        ("channels=motion", "dt"),
        ("camera=nope", "camera"),
        ("camera=view_0&index=1", "index"),
        ("eye=1,0,0&target=1,0,0", "target"),
    ],
)
def test_an_invalid_query_is_refused_by_parameter(client: httpx.Client, query: str, field: str):
    response = client.get(f"/render?{query}")
    check_problem(response, 422, field)
    assert "camera." not in response.text


def camera_path(*scales: float, **size: int) -> dict[str, Any]:
    """A camera path in nerfstudio's format; poses of another scale than 1 are invalid."""
    cameras = [{"camera_to_world": np.diag([scale, scale, scale, 1.0]).ravel().tolist(), "fov": 40} for scale in scales]
    return {"camera_path": cameras, **size}


@pytest.mark.parametrize(
    ("body", "field"),
    [
        ({"frames": [FILM_FRAME, {**FILM_FRAME, "camera": {"type": "scene", "index": 99}}]}, "frames.1.camera.index"),
        ({"frames": [FILM_FRAME, {**FILM_FRAME, "t": 2}]}, "frames.1.t"),
        ({"frames": [{**FILM_FRAME, "camera": PIXELS}]}, "width"),
        ({"frames": [FILM_FRAME] * 4}, "frames"),
        ({"path": camera_path(1, 2, render_width=9, render_height=9)}, "path.camera_path.1.camera_to_world"),
        ({"path": camera_path(1, render_width=9)}, "path.render_height"),
        ({"path": camera_path(1, render_width=1000, render_height=16000)}, "path.render_height"),
        ({"path": camera_path(1), "width": 16000, "height": 1000}, "width"),
        ({"path": camera_path(1, 1, 1, 1), "width": 9, "height": 9}, "path.camera_path"),
    ],
    ids=lambda value: str(value)[:30],
)
def test_an_invalid_video_is_refused_by_field(client: httpx.Client, body: dict[str, Any], field: str):
    check_problem(client.post("/render/video", json=body), 422, field)


def test_several_times_are_one_array(client: httpx.Client):
    stacked = array(client, t=[0.0, 0.5])
    assert stacked.shape == (2, SIZE, SIZE, 5)
    np.testing.assert_array_equal(stacked[1], array(client, t=0.5))


@pytest.mark.parametrize("image_format", ["png", "jpeg", "webp", "exr"])
def test_several_times_of_images_are_refused_with_the_way_to_them(client: httpx.Client, image_format: str):
    refused = post(client, t=[0.0, 0.5], format=image_format)
    check_problem(refused, 422, "t")
    assert "POST /render/batch" in refused.json()["detail"]


def test_channels_come_in_the_order_asked_for(client: httpx.Client):
    everything = array(client, channels=["rgb", "alpha", "depth"])
    np.testing.assert_array_equal(array(client, channels=["depth", "rgb"]), everything[..., [4, 0, 1, 2]])
    pixels, spec = decode(post(client, format="exr", channels=["depth"]).content, "exr")
    assert spec.channelnames == ("Z",)
    np.testing.assert_array_equal(pixels[..., 0], everything[..., 4])


def test_depth_as_an_image_is_lighter_the_nearer(client: httpx.Client):
    """The nearest point is white, the farthest `FARTHEST_BRIGHTNESS`; low alpha darkens, empty pixels are black."""
    depth, alpha = (array(client, channels=[name])[..., 0] for name in ("depth", "alpha"))
    seen = np.isfinite(depth)
    assert 0 < seen.mean() < 1
    for asked, (near, far) in (({}, (depth[seen].min(), depth[seen].max())), ({"depth_range": [0, 10]}, (0, 10))):
        grey = decode(post(client, channels=["depth"], **asked).content, "png")[0][..., 0].astype(int)
        place = (np.where(seen, depth, far) - near) / (far - near)
        want = 255 * alpha * np.where(seen, 1 - (1 - FARTHEST_BRIGHTNESS) * place, 0)
        assert np.abs(grey - want).max() <= 1


def test_gaussians_per_pixel_are_counted(client: httpx.Client):
    """As numbers and as an image; tests/rasterizer/test_rasterizer_oracle.py verifies the numbers."""
    counts = array(client, channels=["gaussians"])[..., 0]
    assert counts.max() >= 1
    np.testing.assert_array_equal(counts, counts.round())
    np.testing.assert_array_equal(counts > 0, array(client, channels=["alpha"])[..., 0] > 0)
    pixels, spec = decode(post(client, format="exr", channels=["gaussians"]).content, "exr")
    assert spec.channelnames == ("gaussians",)
    np.testing.assert_array_equal(pixels[..., 0], counts)
    grey = decode(post(client, channels=["gaussians"]).content, "png")[0]
    np.testing.assert_allclose(grey[..., 0], 255 * counts / counts.max(), atol=0.5)
    blurred = array(client, channels=["gaussians"], shutter={"open": 0, "close": 0.2, "samples": 2})
    np.testing.assert_allclose(blurred, sum(array(client, channels=["gaussians"], t=t) for t in (0.55, 0.65)) / 2)


def test_motion_blur_is_the_mean_of_frames_in_linear_light(client: httpx.Client):
    shutter, times = {"open": -0.2, "close": 0.2, "samples": 4}, (0.35, 0.45, 0.55, 0.65)
    blurred = array(client, shutter=shutter)
    alpha = np.mean([array(client, t=t)[..., 3] for t in times], axis=0)
    np.testing.assert_allclose(blurred[..., 3], alpha, atol=1e-6)
    opaque = array(client, shutter=shutter, background="scene")
    light = np.mean([srgb_to_linear(array(client, t=t, background="scene")[..., :3]) for t in times], axis=0)
    np.testing.assert_allclose(opaque[..., :3], linear_to_srgb(light), atol=1e-5)
    covered = blurred[..., 3] > 1e-3
    over = linear_to_srgb(srgb_to_linear(blurred[covered][:, :3] / blurred[covered][:, 3:4]))
    assert np.isfinite(over).all()


def test_an_exr_file_has_its_camera_and_its_time(client: httpx.Client):
    camera = client.get("/scenes/balls").json()["cameras"][0]
    body = {"camera": {"type": "scene", "index": 0}, "t": 0.25, "format": "exr"}
    pixels, spec = decode(client.post("/render", json=body).content, "exr")
    assert spec.getattribute("msdgs:time") == 0.25
    assert spec.getattribute("oiio:ColorSpace") == "lin_rec709_scene"
    point = np.array([0.3, -0.2, 0.1, 1.0])
    pose = np.array(camera["camera_to_world"])
    seen = np.linalg.inv(pose) @ point
    to_camera = np.array(spec.getattribute("worldToCamera")).reshape(4, 4)
    np.testing.assert_allclose(point @ to_camera, seen * [1, -1, 1, 1], atol=1e-5)
    x, y, _, w = point @ np.array(spec.getattribute("worldToNDC")).reshape(4, 4)
    expected = [camera["fx"] * seen[0] / seen[2] + camera["cx"], camera["fy"] * seen[1] / seen[2] + camera["cy"]]
    np.testing.assert_allclose([x / w * pixels.shape[1], y / w * pixels.shape[0]], expected, atol=1e-3)
    np.testing.assert_allclose(np.array(spec.getattribute("msdgs:camera_to_world")).reshape(4, 4).T, pose, atol=1e-6)


@in_this_process
def test_requests_have_ids(client: httpx.Client, caplog: pytest.LogCaptureFixture):
    assert client.get("/live", headers={"X-Request-ID": "abc-1.2_3"}).headers["X-Request-ID"] == "abc-1.2_3"
    for bad in ("x" * 65, "a b", '"'):
        made = client.get("/live", headers={"X-Request-ID": bad}).headers["X-Request-ID"]
        assert re.fullmatch("[0-9a-f]{32}", made)
    with caplog.at_level(logging.INFO, "msdgs_serve.access"):
        client.get("/scenes/nothing%0A")

        def told() -> list[logging.LogRecord]:
            """A line is logged after its response, so lines of earlier requests may be late."""
            ours = (record for record in caplog.records if record.name == "msdgs_serve.access")
            return [record for record in ours if "/scenes/nothing" in record.getMessage()]

        eventually(lambda: bool(told()))
    token = request_id.set("the-id")
    line = json.loads(JsonLines().format(told()[0]))
    request_id.reset(token)
    assert (line["status"], line["method"], line["request_id"]) == (404, "GET", "the-id")
    assert line["path"] == "/scenes/nothing\n"
    assert told()[0].getMessage() == "GET /scenes/nothing%0A 404"


def test_other_web_pages_may_call_only_where_they_are_named(scene: Path, client: httpx.Client):
    origin = {"Origin": "https://example.org"}
    assert "access-control-allow-origin" not in client.post("/render", json=FRAME, headers=origin).headers
    for simple in ({}, {"Content-Type": "text/plain"}):  # browsers send these without asking the service first
        check_problem(client.post("/render", content=json.dumps(FRAME), headers=origin | simple), 422, "body")
    with serving(scene, cors_origins=["https://example.org"]) as open_client:
        answer = open_client.post("/render", json=FRAME, headers=origin)
        assert answer.headers["access-control-allow-origin"] == "https://example.org"
        other = open_client.post("/render", json=FRAME, headers={"Origin": "https://example.net"})
        assert "access-control-allow-origin" not in other.headers


def numbers(client: httpx.Client, name: str) -> dict[str, float]:
    lines = client.get("/metrics").text.splitlines()
    pairs = [line.rsplit(" ", 1) for line in lines if line.startswith((f"{name}{{", f"{name} "))]
    return {labels.removeprefix(name): float(value) for labels, value in pairs}


def test_metrics_are_what_the_client_counted(scene: Path):
    count = 40
    with serving(scene) as client:
        for number in range(count):
            assert post(client, t=number % 4 / 4).status_code == 200
            assert post(client, t=7).status_code == 422
        requests = numbers(client, "msdgs_requests_total")
        assert requests['{method="POST",route="/render",status="200"}'] == count
        assert requests['{method="POST",route="/render",status="422"}'] == count
        assert numbers(client, "msdgs_problems_total")['{kind="invalid"}'] == count
        durations = numbers(client, "msdgs_request_seconds_count")
        assert durations['{route="/render",status="200"}'] == durations['{route="/render",status="422"}'] == count
        assert numbers(client, "msdgs_stage_seconds_count")['{stage="encode"}'] == count
        video = {"frames": [{"camera": ORBIT, "t": t} for t in (0.0, 0.5, 1.0)], "width": 16, "height": 16}
        array(client, t=[0.0, 0.5])
        assert client.post("/render/video", json=video).status_code == 200
        assert numbers(client, "msdgs_stage_seconds_count")['{stage="draw"}'] == count + 2 + 3, "by frame"
        lookups = numbers(client, "msdgs_pose_cache_lookups_total")
        assert sum(lookups.values()) == count + 2 + 3 + 1, "and one frame drawn at the start"
        assert numbers(client, "msdgs_scenes") == {'{state="known"}': 1, '{state="loaded"}': 1, '{state="broken"}': 0}


@in_this_process
def test_unknown_methods_are_counted_as_one(client: httpx.Client):
    assert client.request("BREW", "/render").status_code == 405
    assert 'method="other"' in client.get("/metrics").text

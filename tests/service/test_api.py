"""The service over HTTP: responses are decoded and their pixels compared."""

import itertools
import re
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from msdgs_serve.deformation import DeformationSession
from msdgs_serve.imaging import FORMATS, Channel
from msdgs_serve.imaging.encode import numbers
from msdgs_serve.renderer import Renderer, RenderOptions
from msdgs_serve.scene import Camera, Region
from msdgs_serve.scene.camera import orbit
from tests.support.fuzzing import CASES, SEED
from tests.support.images import decode, linear_to_srgb
from tests.support.scene_files import UP, level_camera, metadata, write_scene
from tests.support.scenes import draw
from tests.support.service import ORBIT, check_problem, eventually, serving

SIZE = 64
LEVEL = {**ORBIT, "distance": 5, "fov_y": 40}
FRAME = {"camera": LEVEL, "t": 0.0, "width": SIZE, "height": SIZE}


@pytest.fixture(scope="module")
def client(scene: Path) -> Iterator[httpx.Client]:
    with serving(scene) as client:
        yield client


def render(client: httpx.Client, **changes: Any) -> np.ndarray:
    body = {**FRAME, **changes}
    response = client.post("/render", json=body)
    assert response.status_code == 200, response.text
    image_format = body.get("format", "png")
    assert response.headers["content-type"] == FORMATS[image_format].media_type
    return decode(response.content, image_format)[0]


@pytest.mark.parametrize("t", [0.0, 0.3, 1.0])
def test_the_frame_is_what_the_rasterizer_draws(client: httpx.Client, scene: Path, t: float):
    drawn = draw(DeformationSession(scene).gaussians(t), level_camera(SIZE), background=metadata().background)
    assert np.abs(render(client, t=t) / 255 - drawn.rgb).max() <= 0.5 / 255 + 1e-6
    float_pixels = render(client, t=t, format="exr", background="scene")
    assert np.abs(linear_to_srgb(float_pixels[..., :3]) - drawn.rgb).max() < 1e-5
    np.testing.assert_array_equal(float_pixels[..., 4], drawn.depth)


def test_backgrounds(client: httpx.Client):
    corner = (0, 0)
    np.testing.assert_allclose(render(client)[corner] / 255, metadata().background, atol=0.5 / 255)
    assert render(client, background=[1, 0.5, 0])[corner].tolist() == [255, 128, 0]
    assert render(client, background="transparent")[corner].tolist() == [0, 0, 0, 0]
    np.testing.assert_array_equal(render(client, background=None), render(client, background="transparent"))
    linear = render(client, format="exr")
    assert linear[corner][:4].tolist() == [0, 0, 0, 0]
    assert np.isinf(linear[corner][4])


def test_layers_are_applied_one_after_the_other(tmp_path: Path, client: httpx.Client):
    with serving(write_scene(tmp_path / "balls.onnx", steps=True)) as by_layers:
        assert by_layers.get("/scenes/balls").json()["steps"] == 1
        for t, steps in ((0.75, 0), (0.75, 0.5), (0.75, 1)):
            assert np.array_equal(render(by_layers, t=t, steps=steps), render(client, t=t * steps))
        link = f"/render?azimuth=0&elevation=0&distance=5&fov_y=40&width={SIZE}&height={SIZE}&t=0.75&steps=0.5"
        answer = by_layers.get(link)
        assert np.array_equal(decode(answer.content, "png")[0], render(client, t=0.375))
        check_problem(by_layers.post("/render", json={**FRAME, "steps": 2}), 422, "steps")
    assert client.get("/scenes/balls").json()["steps"] == 0
    check_problem(client.post("/render", json={**FRAME, "steps": 0}), 422, "steps")


def test_a_region_is_a_part_of_the_image(client: httpx.Client):
    x, y, width, height = region = [11, 20, 37, 30]

    def part(of: np.ndarray) -> np.ndarray:
        return of[..., y : y + height, x : x + width, :]

    for changes in (
        {"format": "png"},
        {"format": "png", "channels": ["depth"], "depth_range": [4, 6]},
        {"format": "npy", "channels": ["rgb", "alpha", "depth", "motion", "gaussians"], "dt": 0.1},
        {"format": "npy", "t": [0.0, 0.7], "shutter": {"open": 0.0, "close": 0.1, "samples": 2}},
        {"format": "exr"},
    ):
        whole = render(client, **changes)
        np.testing.assert_array_equal(render(client, **changes, region=region), part(whole))
        np.testing.assert_array_equal(render(client, **changes, region=[0, 0, SIZE, SIZE]), whole)
    body = client.post("/render", json={**FRAME, "format": "exr", "region": region}).content
    spec = decode(body, "exr")[1]
    assert (spec.x, spec.y, spec.width, spec.height) == tuple(region)
    assert (spec.full_x, spec.full_y, spec.full_width, spec.full_height) == (0, 0, SIZE, SIZE)
    link = f"/render?azimuth=0&elevation=0&distance=5&fov_y=40&width={SIZE}&height={SIZE}&region=11,20,37,30"
    np.testing.assert_array_equal(decode(client.get(link).content, "png")[0], part(render(client)))
    check_problem(client.get(f"{link[:-1]}x"), 422, "region")
    depths = {**FRAME, "channels": ["depth"], "depth_range": [3, 6], "region": region}
    link += "&channels=depth&depth_range="
    assert client.get(f"{link}3,6").content == client.post("/render", json=depths).content
    for wrong in ("6,3", "3", "a,b"):
        check_problem(client.get(f"{link}{wrong}"), 422, "depth_range")


def test_parts_of_an_image_beyond_the_limit_of_pixels_are_drawn(client: httpx.Client):
    """16,384 × 8,192 pixels are 15 times the limit. Neighboring parts are those of one larger part."""
    huge = {"width": 16_384, "height": 8_192, "format": "npy"}
    whole = render(client, **huge, region=[8_100, 4_000, 100, 90])
    assert whole[..., 3].max() > 0
    parts = [render(client, **huge, region=[8_100 + x, 4_000, width, 90]) for x, width in ((0, 33), (33, 67))]
    np.testing.assert_array_equal(np.concatenate(parts, axis=1), whole)
    check_problem(client.post("/render", json={**FRAME, **huge}), 422, "width")
    check_problem(client.post("/render", json={**FRAME, **huge, "region": [0, 0, 16_384, 4_096]}), 422, "region")


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"region": [0, 0, SIZE + 1, 1]}, "region"),
        ({"region": [SIZE, 0, 1, 1]}, "region"),
        ({"region": [0, 0, 8, 0]}, "region.3"),
        ({"region": [-1, 0, 8, 8]}, "region.0"),
        ({"region": [0, 0.5, 8, 8]}, "region.1"),
        ({"region": [0, 0, 8]}, "region.3"),
        ({"region": [0, 0, 8, 8], "channels": ["depth"]}, "depth_range"),
        ({"region": [0, 0, 8, 8], "channels": ["gaussians"]}, "region"),
        ({"region": [0, 0, 8, 8], "channels": ["motion"], "dt": 0.1}, "region"),
    ],
)
def test_regions_that_cannot_be_drawn(client: httpx.Client, changes: dict[str, Any], field: str):
    check_problem(client.post("/render", json={**FRAME, **changes}), 422, field)


def test_cameras_of_other_models(client: httpx.Client):
    """All models agree at the center of the image and differ away from it."""
    pose = level_camera(SIZE).camera_to_world
    matrix = {"type": "matrix", "camera_to_world": pose.tolist(), "fx": 100.0}
    pinhole, middle = render(client, camera=matrix).astype(int), (SIZE // 2, SIZE // 2)
    for changes in ({"model": "fisheye"}, {"model": "fisheye", "distortion": [0.5, 0, 0, 0]}):
        other = render(client, camera={**matrix, **changes}).astype(int)
        assert np.abs(other[middle] - pinhole[middle]).max() <= 2
        assert np.abs(other - pinhole).max() > 5
    flat = {**matrix, "model": "orthographic", "fx": 20.0}
    nearer = {**flat, "camera_to_world": (pose + np.outer(pose[:, 2], [0, 0, 0, 1])).tolist()}
    np.testing.assert_allclose(render(client, camera=nearer), render(client, camera=flat).astype(int), atol=1)


def test_a_camera_of_the_scene_by_index_or_name(client: httpx.Client):
    by_index = render(client, camera={"type": "scene", "index": 1}, width=None, height=None)
    assert by_index.shape == (48, 64, 3)
    by_name = render(client, camera={"type": "scene", "name": "view_90"}, width=64, height=48)
    np.testing.assert_array_equal(by_index, by_name)
    stored = client.get("/scenes/balls").json()["cameras"][1]
    intrinsics = {name: stored[name] for name in ("fx", "fy", "cx", "cy", "camera_to_world")}
    np.testing.assert_array_equal(
        render(client, camera={"type": "matrix", **intrinsics}, width=64, height=48), by_index
    )
    short = render(client, camera={"type": "orbit", "azimuth": 90, "elevation": 20}, width=None, height=None)
    assert np.abs(short.astype(int) - by_index).max() <= 1, "omitted fields have the scene's values"
    for given, shape in (({"width": 128}, (96, 128, 3)), ({"height": 12}, (12, 16, 3))):
        size = {"width": None, "height": None, **given}
        assert render(client, camera={"type": "scene", "index": 0}, **size).shape == shape


@pytest.mark.parametrize(("width", "height"), [(128, 48), (32, 48), (200, 96)])
def test_pixels_of_a_camera_of_the_scene_keep_their_shape(client: httpx.Client, width: int, height: int):
    camera = {"type": "scene", "index": 0}
    wide, own = (render(client, camera=camera, width=w, height=height) for w in (width, height * 64 // 48))
    left = (width - own.shape[1]) // 2
    inner, outer = (own, wide[:, left:]) if left > 0 else (wide, own[:, -left:])
    np.testing.assert_allclose(outer[:, : inner.shape[1]].astype(int), inner, atol=1)


def test_what_has_no_effect_or_lacks_its_size_is_refused(client: httpx.Client):
    pose = client.get("/scenes/balls").json()["cameras"][0]["camera_to_world"]
    matrix = {"type": "matrix", "camera_to_world": pose, "fov_y": 40, "cx": 32}
    check_problem(client.post("/render", json={"camera": matrix, "t": 0.5}), 422, "width")
    for change in ({}, {"format": "exr", "channels": ["depth"]}, {"channels": ["alpha"]}):
        check_problem(client.post("/render", json={**FRAME, **change, "depth_range": [1, 9]}), 422, "depth_range")
    check_problem(client.get("/render?t=0.1&t=0.9"), 422, "t")
    check_problem(client.get("/render?channels=rgb&channels=depth&format=exr"), 422, "channels")


def test_whole_numbers_may_have_a_decimal_point(client: httpx.Client):
    assert render(client, width=32.0, height=24.0).shape == (24, 32, 3)
    check_problem(client.post("/render", json={**FRAME, "width": 32.5}), 422, "width")


@pytest.mark.parametrize("count", [94, 110])
def test_the_time_between_frames_reaches_the_end(client: httpx.Client, count: int):
    body = {**FRAME, "t": np.linspace(0, 1, count)[-2], "dt": 1 / (count - 1), "channels": ["motion"]}
    assert client.post("/render", json=body).status_code == 200
    check_problem(client.post("/render", json={**body, "dt": 1.001 / (count - 1)}), 422, "dt")


def test_a_scene_without_cameras_is_framed_by_its_bounds(tmp_path: Path):
    with serving(write_scene(tmp_path / "bare.onnx", cameras=())) as client:
        pixels = render(client, camera={"type": "orbit", "azimuth": 0, "elevation": 0}, width=None, height=None)
        assert pixels.shape == (512, 512, 3)
        assert pixels[256, 256].argmax() == 0
        check_problem(client.post("/render", json={**FRAME, "camera": {"type": "scene"}}), 422, "camera.index")


def test_eight_clients_at_once_get_the_bytes_that_one_gets(client: httpx.Client):
    formats = itertools.cycle(FORMATS)
    bodies = [
        {**FRAME, "width": 1 + 12 * i, "height": 78 - 11 * i, "t": i % 3 / 2, "format": next(formats)} for i in range(8)
    ]

    def post(body: dict[str, Any]) -> bytes:
        response = client.post("/render", json=body)
        assert response.status_code == 200, response.text
        return response.content

    alone = [post(body) for body in bodies]
    with ThreadPoolExecutor(8) as pool:
        assert list(pool.map(post, bodies * 4)) == alone * 4


def test_scenes_are_listed_and_described(client: httpx.Client):
    assert client.get("/scenes").json() == {
        "scenes": [{"name": "balls", "loaded": True, "problem": False, "reason": None}]
    }
    described = client.get("/scenes/balls").json()
    assert described["gaussians"] == {"moving": 1, "static": 1, "total": 2}
    assert described["time_range"] == [0, 1]
    assert described["plan"] == "network"
    assert [camera["name"] for camera in described["cameras"]] == ["view_0", "view_90"]
    assert described["measured_error"] == metadata().measured_error


def test_several_scenes_need_a_name(tmp_path: Path):
    write_scene(tmp_path / "red.onnx")
    write_scene(tmp_path / "blue.onnx", static_color=(0, 0, 1))
    with serving(tmp_path) as client:
        assert [scene["name"] for scene in client.get("/scenes").json()["scenes"]] == ["blue", "red"]
        assert render(client, scene="red")[SIZE // 2, SIZE // 2].argmax() == 0
        assert render(client, scene="blue")[SIZE // 2, SIZE // 2].argmax() == 2
        check_problem(client.post("/render", json=FRAME), 422, "scene")
        check_problem(client.post("/render", json={**FRAME, "scene": "green"}), 404, "scene")
        for example in examples(client).values():
            assert client.post("/render", json=example["value"]).status_code == 200


def test_a_scene_that_breaks_is_reported_and_goes_on(tmp_path: Path):
    path = write_scene(tmp_path / "balls.onnx")
    with serving(tmp_path) as client:
        before = render(client)
        path.write_bytes(b"no scene")
        np.testing.assert_array_equal(render(client), before)
        eventually(lambda: client.get("/scenes").json()["scenes"][0]["problem"])
        assert client.get("/scenes").json()["scenes"][0]["loaded"]
        np.testing.assert_array_equal(render(client), before)
        write_scene(path, static_color=(0, 0, 1))
        eventually(lambda: render(client)[SIZE // 2, SIZE // 2].argmax() == 2)
        assert client.get("/scenes").json()["scenes"] == [
            {"name": "balls", "loaded": True, "problem": False, "reason": None}
        ]


def test_a_scene_broken_from_the_start_is_unavailable_without_revealing_its_path(tmp_path: Path):
    (tmp_path / "broken.onnx").write_bytes(b"no scene")
    with serving(tmp_path) as client:
        for response in (client.post("/render", json=FRAME), client.get("/scenes/broken")):
            check_problem(response, 503)
            assert str(tmp_path) not in response.text
        assert client.get("/openapi.json").status_code == 200


def examples(client: httpx.Client) -> dict[str, Any]:
    call = client.get("/openapi.json").json()["paths"]["/render"]["post"]
    return call["requestBody"]["content"]["application/json"]["examples"]


def test_every_example_in_the_documentation_works(client: httpx.Client):
    found = examples(client)
    assert {example["value"]["camera"]["type"] for example in found.values()} == {"orbit", "look_at", "matrix", "scene"}
    for name, example in found.items():
        response = client.post("/render", json=example["value"])
        assert response.status_code == 200, (name, response.text)
        pixels, _ = decode(response.content, example["value"].get("format", "png"))
        assert pixels[..., :3].std() > 0, f"{name} shows nothing"


def test_pages_about_the_calls_need_nothing_from_elsewhere(client: httpx.Client):
    for page in ("/docs", "/redoc"):
        text = client.get(page).text
        sources = re.findall(r"(?:src|href)=[\"']([^\"']+)", text)
        assert [source for source in sources if source.endswith(".js")], text
        for source in sources:
            assert source.startswith("/"), source
            assert client.get(client.base_url.copy_with(path=source)).status_code == 200, source


@pytest.mark.slow
def test_frames_of_any_sequence_of_requests_are_those_of_a_fresh_service(tmp_path: Path):
    """Repeated cameras at other times, sizes, regions, channels and backgrounds, and files that change in between."""
    path = write_scene(tmp_path / "balls.onnx")
    plain = Renderer(cache_bytes=0, sequence_bytes=0)
    with serving(path) as client:
        for seed in range(SEED, SEED + CASES):
            random = np.random.default_rng(seed)
            if seed % 5 == 0:
                write_scene(path, static_color=tuple(random.uniform(size=3).round(2).tolist()))
            session = DeformationSession(path)
            eventually(lambda s=session: client.get("/scenes/balls").json()["sha256"] == s.sha256)
            for _ in range(8):
                size, azimuth = int(random.choice([24, 40])), int(random.choice([0, 35]))
                t, depth = round(random.uniform(), 3), bool(random.integers(2))
                region = [None, (3, 5, 16, 19)][int(random.integers(2))]
                background = [None, (0.1, 0.2, 0.3)][int(random.integers(2))]
                body = {"camera": {**LEVEL, "azimuth": azimuth}, "t": t, "width": size, "height": size, "format": "npy"}
                channels: list[Channel] = ["rgb", "alpha", "depth"] if depth else ["rgb", "alpha"]
                got = render(client, **body, channels=channels, background=background, region=region)
                camera = Camera.from_fov(orbit(np.zeros(3), 5.0, azimuth, 0, UP), size, size, 40.0)
                options = RenderOptions(background or "transparent", depth=depth, region=region and Region(*region))
                image = plain.render(session, camera, t, options)
                np.testing.assert_array_equal(got, numbers(image, channels))
        frames = re.search(
            r'^msdgs_sequence_cache_frames_total\{drawn="moving"\} (\S+)$', client.get("/metrics").text, re.M
        )
        assert frames is not None
        assert float(frames[1]) > 0

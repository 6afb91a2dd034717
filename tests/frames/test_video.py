"""Camera paths, videos over HTTP, and `msdgs-render`."""

import io
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av
import httpx
import numpy as np
import OpenImageIO as oiio
import pytest
from av.video.reformatter import ColorRange

from msdgs_serve import camera_path
from msdgs_serve.camera_path import CameraPath, read_nerfstudio
from msdgs_serve.render_cli import main
from msdgs_serve.scene import InvalidInput
from msdgs_serve.video import BT709, VIDEO_FORMATS, VideoFormat, write_video
from tests.support.images import decode, psnr
from tests.support.scene_files import level_camera
from tests.support.service import check_problem, serving
from tests.support.tolerances import assert_close, tolerance
from tests.support.videos import frames_of, nerfstudio, run, stills_of

SIZE = 64
POSE = level_camera().camera_to_world
ORBIT = {"type": "orbit", "azimuth": 0, "elevation": 0, "distance": 5, "fov_y": 40}


@pytest.fixture(scope="module")
def client(scene: Path) -> Iterator[httpx.Client]:
    with serving(scene, max_video_frames=10, max_video_pixels=10 * 100 * 100) as client:
        yield client


def test_nerfstudios_path_is_read():
    path = read_nerfstudio(nerfstudio(), (0.0, 2.0))
    assert path.fps == 12
    assert [t for _, t in path.frames] == [0.0, 1.0, 2.0]
    camera, expected = path.frames[0][0], level_camera(SIZE)
    np.testing.assert_allclose(camera.camera_to_world, expected.camera_to_world, atol=1e-12)
    assert (camera.fx, camera.cx, camera.width) == pytest.approx((expected.fx, expected.cx, SIZE))
    document = nerfstudio(camera_type="perspective")
    document["camera_path"][1]["render_time"] = 0.9
    assert read_nerfstudio(document, (0.0, 2.0)).frames[1][1] == pytest.approx(1.8)
    assert read_nerfstudio(document, (0.0, 2.0), (32, 16)).frames[0][0].height == 16


KEYFRAME = {"matrix": "[1]", "fov": 50, "aspect": 1.5, "override_transition_enabled": False}
HARMLESS = {"keyframes": [KEYFRAME], "default_fov": 75, "default_transition_sec": 2.0, "is_cycle": True, "aspect": 1.5}
HARMLESS |= {"smoothness_value": 0.5}
CAMERA = nerfstudio()["camera_path"][0]
APPLIED = {
    "camera_path": {"camera_path": [CAMERA] * 4},
    "camera_to_world": {"camera_path": [{**CAMERA, "camera_to_world": np.eye(4).ravel().tolist()}] * 3},
    "fov": {"camera_path": [{**CAMERA, "fov": 50}] * 3},
    "render_time": {"camera_path": [{**CAMERA, "render_time": 0.3}] * 3},
    "render_width": {"render_width": 32},
    "render_height": {"render_height": 32},
    "fps": {"fps": 5},
    "seconds": {"fps": None, "seconds": 1.5},
}
CROP = {"crop_center": [0, 0, 0], "crop_scale": [1, 1, 1], "crop_bg_color": {"r": 1, "g": 2, "b": 3}}


def shown(path: CameraPath) -> str:
    return repr([(camera, camera.camera_to_world.tolist(), t, path.fps) for camera, t in path.frames])


def test_fields_that_made_the_path_have_no_effect():
    plain = read_nerfstudio(nerfstudio(), (0.0, 1.0))
    path = read_nerfstudio(nerfstudio(**HARMLESS, crop=None), (0.0, 1.0))
    assert (shown(path), path.warnings) == (shown(plain), ())


@pytest.mark.parametrize("name", APPLIED)
def test_an_applied_field_of_a_path_has_an_effect(name: str):
    plain, path = (read_nerfstudio(nerfstudio(**changes), (0.0, 1.0)) for changes in ({}, APPLIED[name]))
    assert shown(path) != shown(plain)


def test_each_field_of_a_path_has_an_example():
    """Scenes of cameras are read by `msdgs-render`."""
    uses = {**dict.fromkeys(APPLIED, "applied"), **dict.fromkeys(HARMLESS, "harmless")}
    assert {**uses, "scene": "applied", "crop": "refused", "camera_type": "refused"} == camera_path.FIELDS.uses


def test_seconds_make_the_frame_rate_of_a_path_without_one():
    document = nerfstudio(6, fps=None, seconds=1.5)
    assert read_nerfstudio(document, (0.0, 1.0)).fps == 4.0
    del document["fps"]
    assert read_nerfstudio(document, (0.0, 1.0)).fps == 4.0
    assert read_nerfstudio(nerfstudio(6, fps=12, seconds=1.5), (0.0, 1.0)).fps == 12
    assert read_nerfstudio(nerfstudio(6, fps=None, seconds=None), (0.0, 1.0)).fps == 24


def test_unknown_fields_of_a_path_are_named_once(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    document = nerfstudio(haze=1)
    for camera in document["camera_path"]:
        camera["shutter"] = 0.5
    assert read_nerfstudio(document, (0.0, 1.0)).warnings == (
        "not read, as no known field of a camera path: `haze`, `shutter` of cameras",
    )
    (tmp_path / "path.json").write_text("\ufeff" + json.dumps(document), encoding="utf-8")
    assert main([str(scene), str(tmp_path / "out"), "--path", str(tmp_path / "path.json")]) == 0
    assert f"msdgs-render: warning: {tmp_path / 'path.json'}: not read, as" in capsys.readouterr().err


def test_known_fields_in_the_wrong_place_are_not_read():
    document = nerfstudio(render_time=0.5)
    document["camera_path"][0]["render_width"] = 9
    (warning,) = read_nerfstudio(document, (0.0, 1.0)).warnings
    assert warning.endswith(": `render_time`, `render_width` of cameras")


def test_angles_that_may_be_in_radians_are_told():
    path = read_nerfstudio(nerfstudio(camera_path=[{**CAMERA, "fov": 0.87}] * 2), (0.0, 1.0))
    assert path.warnings == ("each `fov` is below 3.15, as angles in radians are; it is read in degrees",)
    assert not read_nerfstudio(nerfstudio(camera_path=[{**CAMERA, "fov": 2}, CAMERA]), (0.0, 1.0)).warnings


def test_rows_of_a_matrix_and_whole_sizes_may_be_written_otherwise():
    rows = np.reshape(CAMERA["camera_to_world"], (4, 4)).tolist()
    changed = nerfstudio(camera_path=[{**CAMERA, "camera_to_world": rows}] * 2, render_width=float(SIZE))
    plain = nerfstudio(camera_path=[CAMERA] * 2)
    assert shown(read_nerfstudio(changed, (0.0, 1.0))) == shown(read_nerfstudio(plain, (0.0, 1.0)))


def test_a_matrix_by_columns_is_named():
    columns = np.reshape(CAMERA["camera_to_world"], (4, 4)).T.ravel().tolist()
    with pytest.raises(InvalidInput, match="last row is 0 0 0 1, not its last column"):
        read_nerfstudio(nerfstudio(camera_path=[{**CAMERA, "camera_to_world": columns}]), (0.0, 1.0))


def test_a_path_without_cameras_says_what_is_missing(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    for text, message in (
        (
            json.dumps(nerfstudio(camera_path=[])),
            "one camera or more, which nerfstudio's viewer writes if its path",
        ),
        ("{", "must be a JSON file of nerfstudio's camera path, got .*, which is none from line 1, column 2 on"),
        ("\x00", "must be a JSON file of nerfstudio's camera path, got "),
        (
            '{"frames": []}',
            "camera_path` must be a list of cameras, as nerfstudio's viewer saves, got a dataset's `frames`",
        ),
    ):
        (tmp_path / "path.json").write_text(text)
        assert main([str(scene), str(tmp_path / "out"), "--path", str(tmp_path / "path.json")]) == 2
        assert re.search(message, capsys.readouterr().err)


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"camera_path": []}, "camera_path"),
        ({"crop": CROP}, "crop"),
        ({"crop": False}, "crop"),
        ({"fps": None, "seconds": 0}, "seconds"),
        ({"fps": None, "seconds": -1}, "seconds"),
        ({"fps": None, "seconds": "1"}, "seconds"),
        ({"camera_type": "fisheye"}, "camera_type"),
        ({"camera_path": [{**CAMERA, "camera_type": "fisheye"}]}, "camera_path.0.camera_type"),
        ({"camera_path": [{**CAMERA, "crop": CROP}]}, "camera_path.0.crop"),
        ({"camera_path": [{**CAMERA, "camera_to_world": [[1, 0], [0, 1]] * 2}]}, "camera_path.0.camera_to_world"),
        ({"camera_path": "x"}, "camera_path"),
        ({"camera_path": [1]}, "camera_path.0"),
        ({"camera_path": [{"camera_to_world": [1] * 15, "fov": 40}]}, "camera_path.0.camera_to_world"),
        ({"camera_path": [{"camera_to_world": [float("nan")] * 16, "fov": 40}]}, "camera_path.0.camera_to_world"),
        ({"camera_path": [{"camera_to_world": np.eye(4).ravel().tolist(), "fov": 180}]}, "camera_path.0.fov"),
        ({"camera_path": [{"camera_to_world": np.eye(4).ravel().tolist()}]}, "camera_path.0.fov"),
        ({"fps": 0}, "fps"),
        ({"fps": 1e-4}, "fps"),
        ({"camera_type": "equirectangular"}, "camera_type"),
        ({"camera_type": ["perspective"]}, "camera_type"),
        ({"render_width": None}, "render_width"),
        ({"render_height": 1.5}, "render_height"),
        ({"render_height": 10**400}, "render_height"),
        ({"fps": 10**400}, "fps"),
        ({"camera_path": [{"camera_to_world": [10**400] * 16, "fov": 40}]}, "camera_path.0.camera_to_world"),
    ],
    ids=str,
)
def test_an_invalid_path_is_refused_by_key(client: httpx.Client, changes: dict[str, Any], field: str):
    document = nerfstudio(**changes)
    with pytest.raises(InvalidInput) as error:
        read_nerfstudio(document, (0.0, 1.0))
    assert error.value.field == field
    response = client.post(
        "/render/video", content=json.dumps({"path": document}), headers={"Content-Type": "application/json"}
    )
    check_problem(response, 422)


@pytest.mark.parametrize("video_format", ["mp4", "webm"])
def test_a_video_shows_the_frames(client: httpx.Client, video_format: str):
    times = [0.0, 0.25, 0.5, 0.75, 1.0]
    body = {"frames": [{"camera": ORBIT, "t": t} for t in times], "width": SIZE, "height": SIZE, "fps": 5.0}
    response = client.post("/render/video", json={**body, "format": video_format})
    assert response.status_code == 200, response.text
    assert response.headers["Content-Type"] == f"video/{video_format}"
    frames, rate = frames_of(response.content)
    assert (len(frames), rate) == (5, 5.0)
    for t, frame in zip(times, frames, strict=True):
        alone = client.post("/render", json={"camera": ORBIT, "t": t, "width": SIZE, "height": SIZE})
        assert psnr(frame / 255, decode(alone.content, "png")[0] / 255) > 20
    by_path = client.post("/render/video", json={"path": nerfstudio(5), "fps": 5.0, "format": video_format})
    assert len(frames_of(by_path.content)[0]) == 5


@pytest.mark.parametrize("fps", [24.0, 29.97])
@pytest.mark.parametrize("video_format", ["mp4", "webm"])
def test_frames_are_at_their_times_from_0_on(video_format: VideoFormat, fps: float):
    """Also where the encoder stores them in another order."""
    file, gray = io.BytesIO(), np.random.default_rng(0).integers(0, 255, (24, 1, 1, 1))
    write_video((np.full((SIZE, SIZE, 3), value, np.uint8) for value in gray), fps, video_format, file)
    with av.open(io.BytesIO(file.getvalue()), "r") as container:
        times = [float(frame.time or 0) for frame in container.decode(video=0)]
    np.testing.assert_allclose(times, np.arange(24) / fps, atol=1e-3)  # WebM counts milliseconds


@pytest.mark.parametrize("video_format", ["mp4", "webm"])
def test_it_can_be_played_before_all_frames_are_there(video_format: VideoFormat):
    file, written = io.BytesIO(), []

    def frames() -> Iterator[np.ndarray]:
        noise = np.random.default_rng(0).integers(0, 255, (SIZE, SIZE, 3), np.uint8)  # key frames would be large
        for _ in range(100):
            written.append(file.tell())
            yield noise

    write_video(frames(), 24, video_format, file)
    assert written[-1] > 0
    shown = frames_of(file.getvalue()[: written[-1]])[0]
    assert len(shown) >= 20


def test_warnings_about_a_path_are_a_header(client: httpx.Client):
    rows = [{**CAMERA, "camera_to_world": np.reshape(CAMERA["camera_to_world"], (4, 4)).tolist(), "fov": 0.87}] * 2
    path = nerfstudio(camera_path=[{**each, "time": 0.5} for each in rows], render_width=float(SIZE))
    response = client.post("/render/video", json={"path": path})
    assert response.status_code == 200, response.text
    assert "`time` of cameras; each `fov` is below 3.15" in response.headers["Msdgs-Warning"]
    assert "Msdgs-Warning" not in client.post("/render/video", json={"path": nerfstudio(2)}).headers


@pytest.mark.parametrize("video_format", ["mp4", "webm"])
def test_a_video_names_its_colors_as_players_expect(video_format: VideoFormat):
    colors, file = np.uint8(255) * np.eye(3, dtype=np.uint8), io.BytesIO()
    write_video((np.full((SIZE, SIZE, 3), color, np.uint8) for color in colors), 5.0, video_format, file)
    for frame, color in zip(frames_of(file.getvalue())[0], colors, strict=True):
        assert_close(frame[0, 0].astype(float), color, "video_color")
    with av.open(io.BytesIO(file.getvalue()), "r") as container:
        video = container.streams.video[0]
        assert (video.colorspace, video.color_primaries, video.color_trc) == (BT709, BT709, BT709)
        assert video.color_range == ColorRange.MPEG


def test_an_animated_webp_shows_the_frames(tmp_path: Path):
    colors = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255]], np.uint8)
    path = tmp_path / "video.webp"
    with path.open("wb") as file:
        assert write_video((np.full((SIZE, SIZE, 3), color, np.uint8) for color in colors), 5.0, "webp", file) == 3
    file = oiio.ImageInput.open(str(path))
    assert file is not None
    frames = [np.asarray(file.read_image(number, 0, 0, 3, oiio.UINT8)) for number in range(3)]
    assert not file.seek_subimage(3, 0)
    for frame, color in zip(frames, colors, strict=True):
        assert psnr(frame / 255, np.broadcast_to(color, (SIZE, SIZE, 3)) / 255) > 20


@pytest.mark.parametrize(
    ("body", "field"),
    [
        ({}, "frames"),
        ({"frames": [{"camera": ORBIT, "t": 0}], "path": nerfstudio()}, "frames"),
        ({"frames": [{"camera": ORBIT, "t": 0}, {"camera": ORBIT, "t": 2}]}, "frames.1.t"),
        ({"frames": [{"camera": ORBIT, "t": 0}] * 11}, "frames"),
        ({"frames": [{"camera": ORBIT, "t": 0}] * 10, "width": 200, "height": 100}, "frames"),
        ({"path": nerfstudio(), "width": 10}, "width"),
        ({"path": nerfstudio(), "width": 0, "height": 1}, "width"),
        ({"path": nerfstudio(), "format": "gif"}, "format"),
        ({"path": nerfstudio(), "format": "webp", "width": 16384, "height": 2}, "width"),
        ({"path": nerfstudio(), "fps": 1e-4}, "fps"),
    ],
    ids=lambda value: str(value)[:30],
)
def test_invalid_videos(client: httpx.Client, body: dict[str, Any], field: str):
    check_problem(client.post("/render/video", json=body), 422, field)


@pytest.mark.parametrize("video_format", VIDEO_FORMATS)
@pytest.mark.parametrize("size", [(13, 11), (12, 11), (13, 10), (12, 10), (201, 151), (1, 1), (1, 8), (7, 1), (2, 2)])
def test_a_video_has_the_size_that_was_asked_for(video_format: VideoFormat, size: tuple[int, int]):
    width, height = size
    gray = np.linspace(60, 220, height)[:, None] - np.linspace(0, 60, width)
    frames = [np.repeat(gray[..., None] + 20 * number, 3, axis=2).astype(np.uint8) for number in range(2)]
    file = io.BytesIO()
    assert write_video(frames, 24, video_format, file) == 2
    shown = stills_of(file.getvalue()) if video_format == "webp" else frames_of(file.getvalue())[0]
    for frame, expected in zip(shown, frames, strict=True):
        assert frame.shape == (height, width, 3)
        for edge in (np.s_[:], np.s_[-1], np.s_[:, -1]):
            off = np.abs(frame[edge].astype(float) - expected[edge]).mean()
            assert off <= tolerance("video_edge.mean")


@pytest.mark.parametrize("video_format", VIDEO_FORMATS)
def test_odd_sizes_of_both_ways_to_a_video(
    client: httpx.Client, scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], video_format: str
):
    body = {"path": nerfstudio(2, render_width=21, render_height=15), "format": video_format}
    response = client.post("/render/video", json=body)
    file = tmp_path / f"turn.{video_format}"
    assert run(scene, file, "--frames", 2, "--width", 21, "--height", 15) == 0
    printed = capsys.readouterr().out
    assert "2 frames of 21 × 15" in printed
    assert ("of even sizes only" in printed) == (video_format == "mp4")
    for video in (response.content, file.read_bytes()):
        frames = stills_of(video) if video_format == "webp" else frames_of(video)[0]
        assert [frame.shape for frame in frames] == [(15, 21, 3)] * 2
    assert run(scene, tmp_path / f"even.{video_format}", "--frames", 1, "--width", 20, "--height", 14) == 0
    assert "even sizes" not in capsys.readouterr().out

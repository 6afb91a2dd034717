"""`msdgs-render`: images and videos without a service, stopping, resuming and errors."""

import json
from pathlib import Path
from typing import Any

import pytest

from msdgs_serve import blocks, render_cli
from msdgs_serve.imaging import Image, encode
from msdgs_serve.process import EXIT_INTERRUPTED
from msdgs_serve.threads import THREADS_VARIABLE
from tests.support.file_sizes import largest_file
from tests.support.images import decode
from tests.support.scene_files import level_camera
from tests.support.videos import frames_of, nerfstudio, run

SIZE = 64
POSE = level_camera().camera_to_world
ORBIT = {"type": "orbit", "azimuth": 0, "elevation": 0, "distance": 5, "fov_y": 40}


def test_images_of_an_orbit(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = tmp_path / "frames"
    assert run(scene, out, "--frames", 3, "--width", 20, "--height", 10) == 0
    files = sorted(out.glob("frame_*.png"))
    assert [file.name for file in files] == ["frame_00000.png", "frame_00001.png", "frame_00002.png"]
    assert decode(files[0].read_bytes(), "png")[0].shape == (10, 20, 3)
    printed = capsys.readouterr()
    assert "3 frames of 20 × 10" in printed.out
    assert "frame 3 of 3" in printed.err


def test_a_region_of_each_image(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    command = ("--frames", 2, "--width", 40, "--height", 30)
    assert run(scene, tmp_path / "whole", *command) == 0
    assert run(scene, tmp_path / "part", *command, "--region", 9, 5, 20, 16) == 0
    for name in ("frame_00000.png", "frame_00001.png"):
        whole, part = (decode((tmp_path / folder / name).read_bytes(), "png")[0] for folder in ("whole", "part"))
        assert (part == whole[5:21, 9:29]).all()
    assert "2 frames of 20 × 16" in capsys.readouterr().out
    assert run(scene, tmp_path / "part", *command, "--region", 8, 5, 20, 16) == 2, "frames of another region"


@pytest.mark.parametrize(
    ("out", "size", "named"),
    [("frames", 300, "frames"), ("orbit.mp4", 1500, "orbit.mp4"), ("frames", 60, "frames/msdgs-render.json")],
)
def test_on_a_full_disk_the_file_is_named_and_the_same_command_continues(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], out: str, size: int, named: str
):
    command = (scene, tmp_path / out, "--frames", 3, "--width", 20, "--height", 20)
    with largest_file(size):
        assert run(*command) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith(f"msdgs-render: {tmp_path / named}")
    assert ": can't be written: a file may not be as large there" in error
    assert not list(tmp_path.rglob(".msdgs-*"))
    assert run(*command) == 0


def test_a_stopped_command_resumes(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    video, drawn = tmp_path / "orbit.mp4", []

    def encode_two(image: Image, *arguments: Any) -> bytes:
        if len(drawn) == 2:
            raise KeyboardInterrupt
        drawn.append(image.t)
        return encode(image, *arguments)

    command = (scene, video, "--frames", 5, "--width", 16, "--height", 16, "--fps", 10)
    monkeypatch.setattr(blocks, "encode", encode_two)
    assert run(*command) == EXIT_INTERRUPTED
    assert not video.exists()
    monkeypatch.setattr(blocks, "encode", lambda image, *more: drawn.append(image.t) or encode(image, *more))
    assert run(*command) == 0
    assert drawn == [0.0, 0.25, 0.5, 0.75, 1.0]
    frames, rate = frames_of(video.read_bytes())
    assert (len(frames), rate) == (5, 10)
    assert [path.name for path in tmp_path.iterdir()] == ["orbit.mp4"]


def test_a_frame_that_was_cut_off_is_named(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    command = (scene, tmp_path / "orbit.mp4", "--frames", 2, "--width", 64, "--height", 64)
    with monkeypatch.context() as stopped:
        stopped.setattr(render_cli, "write_video", stop)
        assert run(*command) == EXIT_INTERRUPTED
    frame = tmp_path / "orbit.mp4.frames" / "frame_00001.png"
    whole = frame.read_bytes()
    for size in (0, 50, len(whole) // 2):
        frame.write_bytes(whole[:size])
        capsys.readouterr()
        assert run(*command) == 2
        assert f"delete it to have it drawn again, got {frame}" in capsys.readouterr().err
    frame.unlink()
    assert run(*command) == 0


def test_a_path_file_of_nerfstudio(scene: Path, tmp_path: Path):
    (tmp_path / "path.json").write_text(json.dumps(nerfstudio()))
    assert run(scene, tmp_path / "out", "--path", tmp_path / "path.json", "--format", "exr") == 0
    pixels, spec = decode((tmp_path / "out" / "frame_00002.exr").read_bytes(), "exr")
    assert pixels.shape == (SIZE, SIZE, 5)
    assert spec.getattribute("msdgs:time") == 1.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["scene", "out", "--path", "missing.json"], "missing.json"),
        (["scene", "out", "--frames", "0"], "--frames"),
        (["scene", "out", "--width", "10"], "--height"),
        (["scene", "video.gif"], "or a video named .mp4 or .webm or .webp"),
        (["scene", "video.mp4", "--transparent"], "--transparent"),
        (["scene", "video.mp4", "--fps", "0.0001"], "--fps"),
        (["scene", "video.mp4", "--fps", "0"], "--fps"),
        (["scene", "video.webp", "--width", "16384", "--height", "2"], "--width"),
        (["scene", "taken"], "an empty folder"),
        (["missing.onnx", "out"], "missing.onnx"),
        (["scene", "out", "--region", "0", "0", "9999", "1"], "--region"),
        (["scene", "out", "--quality", "80"], "--quality"),
        (["scene", "video.webp", "--quality", "80"], "left out: it is for images"),
        (["scene", "out", "--elevation", "nan"], "--elevation"),
        (["scene", "out", "--width", "0", "--height", "2"], "--width"),
    ],
)
def test_errors_are_one_line(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
    arguments: list[str], message: str,
):  # fmt: skip
    monkeypatch.chdir(tmp_path)
    Path("taken").mkdir()
    Path("taken/something").touch()
    assert run(*(scene if each == "scene" else each for each in arguments)) == 2
    complaint = capsys.readouterr().err
    assert complaint.startswith("msdgs-render: ")
    assert message in complaint
    assert complaint.count("\n") == 1
    assert not list(Path().glob("*.frames")), "before frames are drawn"


@pytest.mark.parametrize(
    ("out", "reason"),
    [
        ("file", "file: there is a file of this name already"),
        ("file/turn.mp4", "file/turn.mp4.frames: a part of the path is a file, not a folder"),
    ],
)
def test_a_file_in_the_way_is_named(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], out: str, reason: str
):
    (tmp_path / "file").touch()
    assert run(scene, tmp_path / out, "--frames", 1) == 2
    assert capsys.readouterr().err == f"msdgs-render: {tmp_path}/{reason}\n"


def test_a_folder_may_have_a_dot_in_its_name(scene: Path, tmp_path: Path):
    (tmp_path / "shot.v2").mkdir()
    assert run(scene, tmp_path / "shot.v2", "--frames", 1, "--width", 8, "--height", 8) == 0
    assert (tmp_path / "shot.v2" / "frame_00000.png").exists()


def test_a_wrong_number_of_threads_is_named(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setenv(THREADS_VARIABLE, "abc")
    assert run(scene, tmp_path / "out", "--frames", 1, "--width", 8, "--height", 8) == 2
    assert f"`{THREADS_VARIABLE}` must be a whole number above 0, got 'abc'" in capsys.readouterr().err


def test_frames_of_another_command_are_not_mixed(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert run(scene, tmp_path / "out", "--frames", 2, "--width", 8, "--height", 8) == 0
    assert run(scene, tmp_path / "out", "--frames", 3, "--width", 8, "--height", 8) == 2
    assert "frames of another command" in capsys.readouterr().err

"""Frames in blocks: every frame once, by scene and time; and `msdgs-render` over several scenes."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from msdgs_serve.blocks import MAX_FRAMES, View, plan_blocks
from msdgs_serve.camera_path import orbit_path, read_scene_names
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.framing import framing
from msdgs_serve.render_cli import main
from msdgs_serve.renderer import Renderer, RenderOptions
from msdgs_serve.scene import Camera, InvalidInput
from tests.frames.test_video import nerfstudio
from tests.support.scene_files import write_scene
from tests.support.tolerances import assert_close

CAMERA = Camera.from_fov(np.eye(4), 8, 8, 40.0)
SCENES = [Path("a.onnx"), Path("b.onnx")]
views = st.lists(st.builds(View, st.sampled_from(SCENES), st.just(CAMERA), st.sampled_from([0.0, 0.25, 1.0])))


@given(views, st.integers(1, 8), st.data())
def test_every_frame_is_in_one_block_by_scene_and_time(views: list[View], workers: int, data: st.DataObject):
    numbers = sorted(data.draw(st.sets(st.sampled_from(range(len(views)))) if views else st.just(set())))
    blocks = plan_blocks(views, numbers, workers)
    assert sorted(frame.number for block in blocks for frame in block.frames) == numbers
    for block in blocks:
        assert 1 <= len(block.frames) <= MAX_FRAMES
        assert all(views[frame.number] == (block.scene, frame.camera, frame.t) for frame in block.frames)
        assert [frame.t for frame in block.frames] == sorted(frame.t for frame in block.frames)
    scenes = [block.scene for block in blocks]
    assert scenes == sorted(scenes, key=scenes.index)


def test_a_time_that_fits_into_one_block_is_not_cut():
    views = [View(SCENES[0], CAMERA, t) for t in np.repeat(np.linspace(0, 1, 7), 6).tolist()]
    blocks = plan_blocks(views, range(len(views)))
    of_times = {t: [block for block in blocks if any(frame.t == t for frame in block.frames)] for _, _, t in views}
    assert all(len(where) == 1 for where in of_times.values())


def test_blocks_are_small_enough_for_all_workers():
    views = [View(SCENES[0], CAMERA, t) for t in np.linspace(0, 1, 64).tolist()]
    assert len(plan_blocks(views, range(64), workers=8)) >= 4 * 8
    assert len(plan_blocks(views, range(64))) == 4


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A path of three cameras through two scenes of different time ranges."""
    write_scene(tmp_path / "one.onnx")
    write_scene(tmp_path / "two.onnx", time_range=(0.0, 0.5))
    document = nerfstudio(3, render_width=16, render_height=16)
    for camera, name in zip(document["camera_path"], ("one", "two", "one"), strict=True):
        camera["scene"] = f"{name}.onnx"
    (tmp_path / "views.json").write_text(json.dumps(document))
    return tmp_path


def test_a_path_through_several_scenes_draws_each_frame_of_its_own(folder: Path):
    assert main([str(folder / "views.json"), str(folder / "out")]) == 0
    for name, numbers in (("one", (0, 2)), ("two", (1,))):
        alone = folder / f"alone_{name}"
        assert main([str(folder / f"{name}.onnx"), str(alone), "--path", str(folder / "views.json")]) == 0
        for number in numbers:
            frame = f"frame_{number:05d}.png"
            assert (folder / "out" / frame).read_bytes() == (alone / frame).read_bytes()


def test_motion_vectors_end_with_the_scenes_time(folder: Path):
    out, file = folder / "out", folder / "two.onnx"  # times in [0, 0.5]
    command = [str(file), str(out), "--frames", "6", "--width", "16", "--height", "16", "--format", "npy"]
    assert main([*command, "--dt", "0.15"]) == 0
    frames = [np.load(out / f"frame_{number:05d}.npy") for number in range(6)]
    assert {frame.shape for frame in frames} == {(16, 16, 7)}
    assert np.abs(frames[0][..., 5:]).max() > 0
    assert not frames[5][..., 5:].any(), "nothing moves afterwards"
    session = DeformationSession(file)
    view = framing(session.scene.metadata)
    path = orbit_path(view.target, view.distance, 20.0, view.up, view.fov_y, (16, 16), 6, (0.0, 0.5))
    for (camera, t), frame, dt in zip(path[1::3], frames[1::3], (0.15, 0.1), strict=True):
        expected = Renderer().render(session, camera, t, RenderOptions("transparent", motion_dt=dt)).motion
        assert expected is not None
        assert_close(frame[..., 5:], expected, "motion_vector")


@pytest.mark.parametrize(("dt", "image_format"), [("0", "exr"), ("nan", "exr"), ("0.1", "png")])
def test_motion_that_cannot_be_is_refused_before_drawing(
    folder: Path, dt: str, image_format: str, capsys: pytest.CaptureFixture[str]
):
    assert main([str(folder / "one.onnx"), str(folder / "out"), "--format", image_format, "--dt", dt]) == 2
    assert "`--dt` must be" in capsys.readouterr().err
    assert not (folder / "out").exists()


@pytest.mark.parametrize(
    ("scene", "out", "option", "value"),
    [
        ("views.json", "out", "--frames", "3"),
        ("views.json", "out", "--elevation", "3"),
        ("one.onnx", "out.mp4", "--format", "exr"),
        ("one.onnx", "out", "--fps", "24"),
    ],
)
def test_options_without_effect_are_refused(
    folder: Path, scene: str, out: str, option: str, value: str, capsys: pytest.CaptureFixture[str]
):
    assert main([str(folder / scene), str(folder / out), option, value]) == 2
    assert f"`{option}` must be left out: it is for" in capsys.readouterr().err
    assert not (folder / out).exists()


@pytest.mark.parametrize("fps", ["nan", "0", "-1"])
def test_frames_per_second_that_cannot_be_are_refused_before_drawing(
    folder: Path, fps: str, capsys: pytest.CaptureFixture[str]
):
    assert main([str(folder / "views.json"), str(folder / "out.mp4"), "--fps", fps]) == 2
    assert "`--fps` must be in" in capsys.readouterr().err
    assert not (folder / "out.mp4.frames").exists()


@pytest.mark.parametrize("name", [None, 3, "one.pt"])
def test_a_camera_without_a_scene_is_named(folder: Path, name: object):
    document = json.loads((folder / "views.json").read_text())
    document["camera_path"][1]["scene"] = name
    (folder / "views.json").write_text(json.dumps(document))
    with pytest.raises(InvalidInput, match=r"camera_path\.1\.scene"):
        read_scene_names(folder / "views.json")


def test_without_ray_the_message_names_the_package(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setitem(sys.modules, "ray", None)
    assert main([str(folder / "one.onnx"), str(folder / "out"), "--frames", "1", "--ray", "auto"]) == 2
    assert "pip install 'msdgs[cluster]'" in capsys.readouterr().err

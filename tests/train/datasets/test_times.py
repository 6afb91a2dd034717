"""Times of datasets: where they come from, what `time_from` changes, and warnings."""

import re
from pathlib import Path

import pytest

from msdgs_serve.scene import InvalidInput
from msdgs_train.datasets import DatasetInvalid, Frame, SceneData, load_scene
from tests.train.datasets.layouts import (
    SMALL,
    dnerf_json,
    intrinsics,
    nerfstudio_json,
    opengl_matrix,
    pose,
    write_colmap,
    write_dnerf,
    write_hypernerf,
    write_nerfstudio,
    write_neu3d,
    write_neu3d_videos,
)

STILL = [(1.0, 0.0, 0.0, 0.0, float(camera), 0.0, 4.0) for camera in range(3)]
"""COLMAP's poses of three cameras."""


def frames_of(scene: SceneData) -> list[Frame]:
    return [frame for frames in scene.splits.values() for frame in frames]


def times_of(scene: SceneData) -> dict[str, float]:
    return {frame.name: frame.t for frame in sorted(frames_of(scene), key=lambda frame: frame.name)}


def colmap(folder: Path, *names: str, time_from: str | None = None, poses: list | None = None) -> SceneData:
    folder = write_colmap(folder, names=names, ending="txt", poses=poses)
    return load_scene(folder, time_from=time_from)


def nerfstudio(folder: Path, *names: str, times: tuple[float, ...] = (), time_from: str | None = None) -> SceneData:
    frames = [
        {"file_path": f"images/{name}", "transform_matrix": opengl_matrix(pose(index))}
        | ({"time": times[index]} if times else {})
        for index, name in enumerate(names)
    ]
    write_nerfstudio(folder, SMALL, content={**intrinsics(SMALL), "frames": frames})
    return load_scene(folder, time_from=time_from)


def test_times_are_scaled_from_the_first_to_the_last(tmp_path: Path):
    scene = colmap(tmp_path, "cam1/take 3 frame 110.png", "cam1/take 3 frame 140.jpg.png", "cam2/take 3 frame 100.png")
    assert list(times_of(scene).values()) == [0.25, 1.0, 0.0]
    assert scene.warnings == ()


def test_cameras_that_stand_still_tell_their_numbers_from_times(tmp_path: Path):
    names = [f"Camera_undist_{index:05}_{camera:02}.png" for index in (1, 9, 17) for camera in range(3)]
    assert list(times_of(colmap(tmp_path, *names, poses=3 * STILL)).values()) == [0, 0, 0, 0.5, 0.5, 0.5, 1, 1, 1]


AMBIGUOUS = (
    "`names of images` have several numbers that may be the time: images/00001_00.png, images/00001_01.png, "
    r"images/00017_02.png would be at 00, 01, 02 with --time-from '^images/\d+_(\d+)', or at 00001, 00001, 00017 with "
    r"--time-from '^images/(\d+)'"
)


def test_ambiguous_names_are_refused_with_three_of_them_and_the_option_for_each_reading(tmp_path: Path):
    names = [f"{index:05}_{camera:02}.png" for index in (1, 9, 17) for camera in range(3)]
    with pytest.raises(DatasetInvalid) as refused:
        colmap(tmp_path, *names)
    for part in (AMBIGUOUS, "--time-from index", "--time-from none"):
        assert part in str(refused.value)
    scene = load_scene(tmp_path, time_from=r"^images/(\d+)")
    assert list(times_of(scene).values()) == [0, 0, 0, 0.5, 0.5, 0.5, 1, 1, 1]


def test_the_numbers_of_cameras_are_not_taken_for_times(tmp_path: Path):
    with pytest.raises(DatasetInvalid, match=r"number of a camera, but none of a time: .*cam1\.png.* --time-from none"):
        colmap(tmp_path, "cam1.png", "cam2.png", "cam3.png")
    assert set(times_of(load_scene(tmp_path, time_from="none")).values()) == {0.0}
    assert list(times_of(load_scene(tmp_path, time_from=r"cam(\d)")).values()) == [0.0, 0.5, 1.0]
    write_colmap(tmp_path, names=("cam1.png", "cam2.png", "cam3.png"), ending="txt", poses=3 * STILL[:1])
    assert list(times_of(load_scene(tmp_path)).values()) == [0.0, 0.5, 1.0]  # a camera on a tripod


def test_names_without_a_time_are_named(tmp_path: Path):
    with pytest.raises(DatasetInvalid, match=r"`images/cam07/front\.png` has no number .*--time-from index"):
        colmap(tmp_path, "a_1.png", "cam07/front.png")
    with pytest.raises(DatasetInvalid, match=r"`images/cam07/front\.png` has no time where 'a_\(\.\)' says"):
        load_scene(tmp_path, time_from="a_(.)")
    assert list(times_of(load_scene(tmp_path, time_from="index")).values()) == [0.0, 1.0]


@pytest.mark.parametrize("time_from", ["name", "frame_", "(a)(b)", "(", "(?P<frame>a)(b)", ""])
def test_another_source_of_times_is_refused(tmp_path: Path, time_from: str):
    with pytest.raises(InvalidInput, match="`time_from` must be names, index, none or a regular expression with one"):
        colmap(tmp_path, "a_1.png", time_from=time_from)


TIME_FROM = {
    "names": [0.0, 0.5, 1.0],
    "index": [0.0, 0.5, 1.0],
    r"f_(?P<time>\d+)_x(\d)": [0.0, 0.5, 1.0],
    r"_x(\d)": [0.0, 0.0, 0.0],
    "none": [0.0, 0.0, 0.0],
}


@pytest.mark.parametrize("times", [(), (0.75, 0.5, 0.25)])
@pytest.mark.parametrize("time_from", [None, *TIME_FROM])
def test_a_source_of_times_replaces_those_of_nerfstudio(
    tmp_path: Path, times: tuple[float, ...], time_from: str | None
):
    scene = nerfstudio(tmp_path, "f_8_x2.png", "f_9_x2.png", "f_10_x2.png", times=times, time_from=time_from)
    expected = TIME_FROM[time_from] if time_from else times or (0.0, 0.0, 0.0)
    found = times_of(scene)
    assert [found[f"images_f_{number}_x2"] for number in (8, 9, 10)] == list(expected)


def test_a_source_of_times_replaces_those_of_other_layouts(tmp_path: Path):
    folders = [tmp_path / name for name in ("dnerf", "neu3d", "videos", "hypernerf")]
    for folder in folders:
        folder.mkdir()
    write_dnerf(folders[0], splits={split: dnerf_json(split, (0.5, 0.25, 0.0)) for split in ("train", "test")})
    write_neu3d(folders[1], count=3)
    write_neu3d_videos(folders[2], counts=(3, 3))
    write_hypernerf(folders[3])
    for folder, count in zip(folders, (3, 3, 3, 4), strict=True):
        for time_from in ("names", "index"):
            scene = load_scene(folder, time_from=time_from)
            assert sorted({frame.t for frame in frames_of(scene)}) == pytest.approx(
                [i / (count - 1) for i in range(count)]
            )
        assert load_scene(folder, time_from="none").time_range == (0.0, 0.0)


def test_held_out_images_keep_their_times(tmp_path: Path):
    write_colmap(tmp_path, names=tuple(f"f_{index}_x2.png" for index in range(9)))
    scene = load_scene(tmp_path, llffhold=4)
    assert [frame.t for frame in scene.splits["test"]] == [0.0, 0.5, 1.0]


# Warnings


def warning_of(scene: SceneData) -> str:
    (warning,) = scene.warnings
    return warning


@pytest.mark.parametrize("layout", ["without times", "equal times", "equal numbers"])
def test_equal_times_are_warned_about(tmp_path: Path, layout: str):
    names = ("a_1.png", "b_1.png")
    if layout == "equal numbers":
        scene = colmap(tmp_path, *names)
    else:
        scene = nerfstudio(tmp_path, *names, times=(3.0, 3.0) if layout == "equal times" else ())
    assert "all 2 images have the same time" in warning_of(scene)
    assert "--time-from names" in warning_of(scene)
    assert load_scene(tmp_path, time_from="none").warnings == ()


def test_one_image_needs_no_time(tmp_path: Path):
    assert colmap(tmp_path, "front.png").warnings == ()


def test_the_same_pose_and_time_twice_are_warned_about(tmp_path: Path):
    names = ("a_1.png", "a_2.png", "b_1.png", "b_2.png")
    assert colmap(tmp_path / "two", *names, poses=[STILL[0], STILL[0], STILL[1], STILL[1]]).warnings == ()
    scene = colmap(tmp_path / "one", *names, poses=4 * STILL[:1])
    assert "2 of 4 images have the pose and the time of another one, such as a_1 and b_1" in warning_of(scene)


@pytest.mark.parametrize(
    ("times", "far"),
    [
        ((0.0, 0.3, 0.5, 1.0, 1000.0), "1 of 5 images, such as images_f_4 at t = 1000, are far in time .* t = 0 to 1:"),
        ((-9.0, 0.3, 0.5, 1.0), "1 of 4 images, such as images_f_0 at t = -9,"),
        ((9998.0, 9999.0, 1.0, 2.0, 3.0), "2 of 5 images, such as images_f_0 at t = 9998,"),
        ((0.0, 0.25, 0.5, 1.0), None),
        ((0.0, 0.0, 1.0, 1.0), None),
        ((0.0, 0.1, 1.0), None),
        ((1, 2, 3, 50, 51, 52, 98, 99, 100), None),
    ],
)
def test_times_far_from_all_others_are_warned_about(tmp_path: Path, times: tuple[float, ...], far: str | None):
    scene = nerfstudio(tmp_path, *(f"f_{index}.png" for index in range(len(times))), times=times)
    if far is None:
        assert scene.warnings == ()
    else:
        assert pytest.approx(1.0) == scene.time_range[1]
        assert re.search(far, warning_of(scene))


@pytest.mark.parametrize("form", ["IMG_{:04}", "DSC{:05}", "_DSC{}", "DSCF{:04}", "_MG_{:04}", "DJI_{:04}"])
def test_numbers_of_photos_are_warned_about(tmp_path: Path, form: str):
    scene = colmap(tmp_path, *(f"{form.format(number)}.png" for number in (998, 999, 1001)))
    assert "numbers of photos" in warning_of(scene)
    assert "--time-from none" in warning_of(scene)


@pytest.mark.parametrize("first", [0, 1])
def test_frames_of_a_video_that_are_called_as_photos_are_not_warned_about(tmp_path: Path, first: int):
    assert colmap(tmp_path, *(f"img_{first + index:05}.png" for index in range(3))).warnings == ()


def test_times_may_be_as_far_apart_as_floats_are(tmp_path: Path):
    scene = nerfstudio(tmp_path, "f_0.png", "f_1.png", "f_2.png", times=(-1.7e308, 0.0, 1.7e308))
    assert sorted(frame.t for frames in scene.splits.values() for frame in frames) == [0.0, 0.5, 1.0]


def test_sound_times_are_not_warned_about(tmp_path: Path):
    folders = [tmp_path / name for name in ("dnerf", "neu3d", "hypernerf", "nerfstudio")]
    for folder in folders:
        folder.mkdir()
    write_dnerf(folders[0])
    write_neu3d(folders[1])
    write_hypernerf(folders[2])
    content = nerfstudio_json(3)
    for index, frame in enumerate(content["frames"]):
        frame["time"] = index / 2
    write_nerfstudio(folders[3], content=content)
    assert [load_scene(folder).warnings for folder in folders] == [()] * 4

"""COLMAP's layout, binary and text: times, points and poses, and files that are cut off."""

from pathlib import Path

import pytest

from msdgs_train.datasets import DatasetInvalid, Frame, load_scene
from tests.support.tolerances import assert_close
from tests.train.datasets.layouts import COLMAP_POINTS, points_of, write_colmap

SPLIT_OF_9 = {"train": [f"v_{index:02}" for index in range(1, 8)], "val": [], "test": ["v_00", "v_08"]}
both = pytest.mark.parametrize("ending", ["bin", "txt"])


@both
@pytest.mark.parametrize("place", ["0", "."])
def test_points_colors_and_size_of_the_scene(tmp_path: Path, ending: str, place: str):
    scene = load_scene(write_colmap(tmp_path, names=("0.png",), ending=ending, place=place))
    points, colors = points_of(scene)
    assert points == [list(position) for position, _ in COLMAP_POINTS]
    assert_close(colors, [[1.0, 0.0, 0.2], [0.0, 0.4, 1.0]], "sh_basis")
    assert 2.0 < scene.scene_half_size <= 3.0


@both
def test_times_are_numbers_of_the_names_and_every_8th_image_is_for_testing(tmp_path: Path, ending: str):
    names = [f"v_{index:02}.png" for index in (8, 2, 3, 0, 1, 4, 5, 6, 7)]
    scene = load_scene(write_colmap(tmp_path, names=tuple(names), ending=ending))
    assert {split: [frame.name for frame in frames] for split, frames in scene.splits.items()} == SPLIT_OF_9
    assert scene.time_range == (0.0, 1.0)
    assert [frame.t for frame in scene.splits["train"]] == [index / 8 for index in range(1, 8)]


def test_every_nth_of_all_images_is_held_out(tmp_path: Path):
    names = tuple(f"v_{index:02}.png" for index in range(9))
    splits = load_scene(write_colmap(tmp_path, names=names, ending="txt"), llffhold=4).splits
    held_out = {split: [int(frame.name[2:]) for frame in frames] for split, frames in splits.items()}
    assert held_out == {"test": [0, 4, 8], "val": [2, 6], "train": [1, 3, 5, 7]}


def test_without_points_the_cameras_determine_the_scene_size(tmp_path: Path):
    folder = write_colmap(tmp_path, names=("0.png",), ending="txt")
    (folder / "sparse" / "0" / "points3D.txt").write_text("# none\n")
    scene = load_scene(folder)
    assert scene.points is None
    assert scene.scene_half_size > 0


@pytest.mark.slow
@pytest.mark.parametrize("part", ["cameras", "images", "points3D"])
def test_a_binary_file_that_is_cut_off_is_refused_wherever_the_cut_is(tmp_path: Path, part: str):
    folder = write_colmap(tmp_path, names=("0.png", "1.png"))
    file = folder / "sparse" / "0" / f"{part}.bin"
    content = file.read_bytes()
    for length in range(len(content)):
        file.write_bytes(content[:length])
        with pytest.raises(DatasetInvalid, match=rf"{part}\.bin: `{part}.*is cut off: the file ends after {length} b"):
            load_scene(folder)


@both
@pytest.mark.parametrize(
    ("pose", "message"),
    [
        ((0.9, float("nan"), 0.1, 0.2, 0.3, -0.2, 4.0), "qvec` must be finite, got .*nan"),
        ((0.9, 0.1, -0.3, 0.2, float("inf"), 0.0, 0.0), "tvec` must be finite, got .*inf"),
        ((0.0, 0.0, 0.0, 0.0, 0.3, -0.2, 4.0), "qvec` is not a rotation"),
    ],
    ids=["nan", "inf", "zero"],
)
def test_invalid_poses_are_refused(tmp_path: Path, ending: str, pose: tuple[float, ...], message: str):
    folder = write_colmap(tmp_path, names=("0.png",), ending=ending, poses=[pose])
    with pytest.raises(DatasetInvalid, match=rf"images\.{ending}: `images\[0\.png\]\.{message}"):
        load_scene(folder)


NAMES = tuple(f"v_{index}.png" for index in range(5))


@both
def test_the_largest_model_is_read_and_images_without_a_pose_are_told(tmp_path: Path, ending: str):
    folder = write_colmap(tmp_path, names=NAMES[:2], ending=ending)
    write_colmap(tmp_path, names=NAMES[1:4], ending=ending, place="1")
    assert [frame.name for frame in frames_of(folder)] == ["v_1", "v_2", "v_3"]
    (warning,) = load_scene(folder).warnings
    assert warning.startswith(
        f"1 of 4 images have no pose in {folder / 'sparse' / '1'} and are left out, first images/v_0"
    )
    assert "the largest of 2 models" in warning
    (folder / "sparse" / "1" / f"images.{ending}").unlink()
    (warning,) = load_scene(folder).warnings
    assert warning.startswith("2 of 4 images have no pose")
    assert "models" not in warning


def test_a_model_may_have_any_number(tmp_path: Path):
    folder = write_colmap(tmp_path, names=NAMES, place="1")
    for hidden in ("._v_0.png", "v_0_mask.png", "masks/v_0.png", "v_0.txt"):
        (folder / "images" / hidden).parent.mkdir(exist_ok=True)
        (folder / "images" / hidden).write_bytes(b"-")
    assert len(frames_of(folder)) == 5
    assert load_scene(folder).warnings == ()


def frames_of(folder: Path) -> list[Frame]:
    splits = load_scene(folder).splits.values()
    return sorted((frame for frames in splits for frame in frames), key=lambda frame: frame.name)

"""Files are found although other systems spell their names differently, or the error shows the difference."""

import json
import unicodedata
from pathlib import Path

import pytest

from msdgs_train.datasets import DatasetInvalid, load_scene
from msdgs_train.datasets.common.paths import find_file, not_found
from tests.train.datasets import layouts
from tests.train.datasets.layouts import SMALL, flat, nerfstudio_json, write_colmap, write_image, write_nerfstudio

COMPOSED, DECOMPOSED = (unicodedata.normalize(form, "Größe é") for form in ("NFC", "NFD"))
SAME_FILE = [
    ("images/a.png", "images/a.png"),
    ("images/a.png", r"images\a.png"),
    ("images/a.png", r".\images\a.png"),
    ("images/a.png", "./images//a.png"),
    ("images/a.png", "images/../images/a.png"),
    ("images/a.png", "images/a"),
    ("images/a.PNG", "images/a.png"),
    ("images/a.PNG", "images/a"),
    ("images/a.png", "Images/A.PNG"),
    ("IMAGES/Sub/a.jpg", r"images\sub\a"),
    (f"{DECOMPOSED}/{DECOMPOSED}.png", f"{COMPOSED}/{COMPOSED}.png"),
    (f"{COMPOSED}/{COMPOSED}.png", f"{DECOMPOSED}\\{DECOMPOSED}"),
    (f"images/{DECOMPOSED.upper()}.png", f"images/{COMPOSED}.png"),
    ("images/STRASSE.png", "images/straße.png"),
]


@pytest.mark.parametrize(("stored", "named"), SAME_FILE)
def test_other_spellings_of_a_name_are_found(tmp_path: Path, stored: str, named: str):
    write_image(tmp_path / stored, flat(0, SMALL))
    found = find_file(tmp_path, named, (".png", ".jpg"))
    assert found is not None
    assert found.samefile(tmp_path / stored)
    absolute = find_file(tmp_path / "elsewhere", str(tmp_path / stored))
    assert absolute == tmp_path / stored


def test_the_exact_name_comes_first_and_two_similar_ones_are_none(tmp_path: Path):
    for name in ("A.png", "a.png"):
        write_image(tmp_path / name, flat(0, SMALL))
    if not (tmp_path / "A.png").samefile(tmp_path / "a.png"):
        assert find_file(tmp_path, "a.png") == tmp_path / "a.png"
        assert find_file(tmp_path, "a.PNG") is None
    for form in ("NFC", "NFD"):
        (tmp_path / unicodedata.normalize(form, "É.png")).touch()
    assert find_file(tmp_path, unicodedata.normalize("NFD", "É.png")) is not None


@pytest.mark.parametrize("name", ["", ".", "..", "images", "none.png", "none/a.png", "/", "\\"])
def test_what_is_no_file_is_none(tmp_path: Path, name: str):
    write_image(tmp_path / "images" / "a.png", flat(0, SMALL))
    assert find_file(tmp_path, name, (".png",)) is None
    assert not_found(tmp_path, name).startswith("there is no such file")


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("images/frame_00001.png", "; there is 'frame_0001.png' in "),
        ("images/frame_0001.jpg", "; there is 'frame_0001.png' in "),
        ("image/frame_0001.png", ": there is no folder "),
        ("/home/somebody/scene/images/frame_0001.png", "; give paths relative to .*: images/frame_0001.png is in "),
        (r"D:\scene\images\frame_0001.png", "; give paths relative to .*: images/frame_0001.png is in "),
        ("/home/somebody/else.png", "; give paths relative to "),
    ],
)
def test_the_error_shows_what_is_there_instead(tmp_path: Path, name: str, hint: str):
    write_image(tmp_path / "images" / "frame_0001.png", flat(0, SMALL))
    content = nerfstudio_json(1, SMALL)
    content["frames"][0]["file_path"] = name
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(DatasetInvalid, match=rf"`frames\[0\]\.file_path` names '.*', but there is no such file{hint}"):
        load_scene(tmp_path)


def test_backslashes_are_separators_in_all_fields(tmp_path: Path):
    content = nerfstudio_json(3, SMALL, ply_file_path=r"sparse\points.ply", mask_path=r"masks\all.png")
    folder = write_nerfstudio(tmp_path, SMALL, content=content)
    write_image(folder / "masks" / "all.png", flat(255, SMALL))
    (folder / "sparse").mkdir()
    header = "ply\nformat ascii 1.0\nelement vertex 1\n" + "".join(f"property float {name}\n" for name in "xyz")
    (folder / "sparse" / "points.ply").write_text(f"{header}end_header\n1 2 3\n")
    for frame in content["frames"]:
        frame["file_path"] = frame["file_path"].replace("/", "\\")
    content |= {"train_filenames": [r"images\f_00.png", "./images/f_02.png"], "test_filenames": [r".\images\f_01.png"]}
    (folder / "transforms.json").write_text(json.dumps(content))
    scene = load_scene(folder)
    names = {split: [frame.name for frame in frames] for split, frames in scene.splits.items()}
    assert names == {"train": ["images_f_00", "images_f_02"], "val": [], "test": ["images_f_01"]}
    assert scene.points is not None
    assert {frame.mask_path for frame in scene.splits["train"]} == {folder / "masks" / "all.png"}


def test_absolute_paths_give_names_as_relative_ones_do(tmp_path: Path):
    content = layouts.dnerf_json(lens=SMALL)
    folder = layouts.write_dnerf(tmp_path, SMALL, splits={"train": content})
    for frame in content["frames"]:
        frame["file_path"] = str(folder / frame["file_path"])
    (folder / "transforms_train.json").write_text(json.dumps(content))
    assert [frame.name for frame in load_scene(folder).splits["train"]] == ["r_0", "r_1"]
    (folder / "transforms_train.json").rename(folder / "transforms.json")
    assert [frame.name for frame in load_scene(folder).splits["train"]] == ["train_r_1"]


@pytest.mark.parametrize("ending", ["bin", "txt"])
def test_colmaps_names_may_have_other_separators_letters_and_forms(tmp_path: Path, ending: str):
    folder = write_colmap(tmp_path, names=(r"cam 1\a_0.png", "B_1.png", f"{COMPOSED}_2.png"), ending=ending)
    for path in list((folder / "images").iterdir()):
        path.unlink()
    for stored in ("cam 1/a_0.PNG", "b_1.png", f"{DECOMPOSED}_2.png"):
        write_image(folder / "images" / stored, flat(0, layouts.COLMAP_LENSES["PINHOLE"]))
    frames = [frame for split in load_scene(folder).splits.values() for frame in split]
    assert {frame.image_path.name for frame in frames} == {"a_0.PNG", "b_1.png", f"{DECOMPOSED}_2.png"}
    assert "cam 1_a_0" in {frame.name for frame in frames}

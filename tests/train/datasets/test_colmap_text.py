"""images.txt as COLMAP and as other programs write it: each image is read once, whatever lines are between."""

from pathlib import Path

import pytest

from msdgs_train.datasets import DatasetInvalid, load_scene
from tests.train.datasets.layouts import write_colmap

NAMES = tuple(f"frame {index}_{index}.png" for index in range(5))
SEEN = "10.5 20.5 -1"
LONG = " ".join(f"{x}.25 {x}.75 {x - 1}" for x in range(40))


def rewritten(folder: Path, after: tuple[str | None, ...], between: str = "\n", first: str = "") -> Path:
    """A model whose images are followed by these lines of observations; None: by no line."""
    write_colmap(folder, names=NAMES, ending="txt")
    file = folder / "sparse" / "0" / "images.txt"
    images = [line for line in file.read_text().split("\n") if line.endswith(".png")]
    lines = [line for image, seen in zip(images, after, strict=True) for line in (image, seen) if line is not None]
    file.write_bytes((first + between.join(lines)).encode())
    return folder


FORMS = {
    "as COLMAP writes it": ((SEEN,) * 5, "\n", "# Image list\n"),
    "no observations at all": ((None,) * 5, "\n", ""),
    "empty lines": (("",) * 5, "\n", "# comment\n"),
    "no line after the last": ((SEEN, SEEN, SEEN, SEEN, None), "\n", ""),
    "some lines": ((SEEN, None, "", None, LONG), "\n", ""),
    "one observation of the model's points": (
        ("1 2 3", "1e2 2 7", "0.5 -2.5 12", None, "1 2 18446744073709551615"),
        "\n",
        "",
    ),
    "many observations": ((LONG,) * 5, "\n", ""),
    "Windows' line ends": ((SEEN, None, "", SEEN, None), "\r\n", "# comment\r\n"),
    "old line ends": ((SEEN, None, "", SEEN, None), "\r", ""),
    "empty lines between": ((SEEN, None, SEEN, None, None), "\n\n", "\n\n"),
    "comments between": ((SEEN, None, "", None, SEEN), "\n# POINTS2D[] as (X, Y, POINT3D_ID)\n", ""),
    "indented comments and a byte-order mark": ((None,) * 5, "\n  # next\n", "\ufeff# Image list\n"),
}


@pytest.mark.parametrize("form", FORMS)
def test_each_image_is_read_once(tmp_path: Path, form: str):
    (tmp_path / "plain").mkdir()
    wanted = load_scene(rewritten(tmp_path / "plain", (SEEN,) * 5)).splits
    splits = load_scene(rewritten(tmp_path, *FORMS[form])).splits
    assert sum(map(len, splits.values())) == 5
    for split, frames in wanted.items():
        for want, got in zip(frames, splits[split], strict=True):
            assert (got.name, got.t) == (want.name, want.t)
            assert (got.camera.camera_to_world == want.camera.camera_to_world).all()


@pytest.mark.parametrize("name", ["1 2 3.png", "10 20 30 40 50 6.png", "a  b_1.png", "0001.png", "1 2 3 x_7.png"])
@pytest.mark.parametrize("seen", [SEEN, None, ""])
def test_names_of_numbers_and_with_spaces_are_names(tmp_path: Path, name: str, seen: str | None):
    write_colmap(tmp_path, names=(name, "z_9.png"), ending="txt")
    file = tmp_path / "sparse" / "0" / "images.txt"
    images = [line for line in file.read_text().split("\n") if line.endswith(".png")]
    file.write_text("\n".join(line for image in images for line in (image, seen) if line is not None))
    frames = [frame for split in load_scene(tmp_path, time_from="none").splits.values() for frame in split]
    assert {frame.image_path.name for frame in frames} == {name, "z_9.png"}


@pytest.mark.parametrize("bad", ["10.5 20.5", "10.5 20.5 -1 3", "10.5 20.5 0.5", "no numbers", "1 2 3 4 5 6 7 8 x a"])
def test_what_is_neither_image_nor_observations_is_named(tmp_path: Path, bad: str):
    with pytest.raises(DatasetInvalid, match=r"images\.txt: `line 4` must be IMAGE_ID QW .* or then X Y POINT3D_ID"):
        load_scene(rewritten(tmp_path, (SEEN, bad, SEEN, None, SEEN)))


def test_observations_before_any_image_are_named(tmp_path: Path):
    with pytest.raises(DatasetInvalid, match=r"images\.txt: `line 1` must be IMAGE_ID QW"):
        load_scene(rewritten(tmp_path, (None,) * 5, first=f"{SEEN}\n"))

"""Masks: which files are masks, which pixels count, and sizes that don't match."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest

from msdgs_train.datasets import DatasetInvalid, Frame, load_scene
from msdgs_train.datasets.cache import ImageCache
from msdgs_train.datasets.common.masks import read_mask
from tests.train.datasets import layouts
from tests.train.datasets.layouts import COLMAP_LENSES, LENSES, SMALL, flat, nerfstudio_json, write_colmap, write_image

LENS = COLMAP_LENSES["PINHOLE"]
HALF = np.arange(16)[:, None] >= np.full((1, 24), 8)  # the lower half counts


def write_pixels(path: Path, pixels: np.ndarray) -> Path:
    """A file with the pixels as they are, of any type and number of channels."""
    writer = oiio.ImageOutput.create(str(path))
    assert writer
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], str(pixels.dtype))
    spec.attribute("oiio:UnassociatedAlpha", 1)
    assert writer.open(str(path), spec)
    assert writer.write_image(pixels)
    assert writer.close()
    return path


def gray(dark: int, light: int, dtype: Any = np.uint8) -> np.ndarray:
    return np.where(HALF, light, dark).astype(dtype)[..., None]


def with_alpha(color: int, alpha: np.ndarray) -> np.ndarray:
    return np.concatenate([np.full((16, 24, 3), color, np.uint8), alpha], axis=2)


@pytest.mark.parametrize(
    "pixels",
    [
        gray(0, 255),
        gray(0, 1),
        gray(0, 128),
        gray(0, 3, np.uint16),
        gray(0, 65535, np.uint16),
        gray(0, 255).repeat(3, axis=2),
        gray(0, 255) * np.array([0, 0, 1], np.uint8),
        with_alpha(255, gray(0, 255)),
        np.concatenate([gray(0, 255), np.full((16, 24, 1), 255, np.uint8)], axis=2),
    ],
    ids=["8 bits", "0 and 1", "gray", "16 bits, small", "16 bits", "RGB", "blue", "transparent", "opaque"],
)
def test_black_pixels_do_not_count(tmp_path: Path, pixels: np.ndarray):
    assert (read_mask(write_pixels(tmp_path / "mask.png", pixels)) == HALF).all()


def test_noise_of_jpeg_is_no_white(tmp_path: Path):
    path = write_pixels(tmp_path / "mask.jpg", gray(0, 255).repeat(3, axis=2))
    assert (read_mask(path) == HALF).all()
    assert (read_mask(write_pixels(tmp_path / "dark.jpeg", gray(9, 240).repeat(3, axis=2))) == HALF).all()


def colmap_with_masks(folder: Path, *masks: str, size: Any = LENS) -> Path:
    write_colmap(folder, names=("a_0.png", "sub/a_1.jpg", "a_2.png"))
    for name in masks:
        write_image(folder / name, flat(255, size))
    return folder


def masks_of(folder: Path) -> dict[str, str]:
    """The masks by the names of the images."""
    frames = [frame for split in load_scene(folder).splits.values() for frame in split]
    return {f.image_path.name: str(f.mask_path.relative_to(folder)) for f in frames if f.mask_path is not None}


@pytest.mark.parametrize(
    "names",
    [
        ("masks/a_0.png.png", "masks/sub/a_1.jpg.png", "masks/a_2.png.png"),
        ("masks/a_0.png", "masks/sub/a_1.jpg", "masks/a_2.png"),
        ("masks/a_0.png", "masks/sub/a_1.png", "masks/a_2.png"),
        ("masks/A_0.PNG.png", "masks/Sub/a_1.JPG.PNG", "masks/a_2.PNG"),
    ],
    ids=["as COLMAP names them", "as the images", "as PNG", "in other letters"],
)
def test_colmaps_masks_are_found_by_name(tmp_path: Path, names: tuple[str, ...]):
    folder = colmap_with_masks(tmp_path, *names)
    assert masks_of(folder) == dict(zip(("a_0.png", "a_1.jpg", "a_2.png"), names, strict=True))
    assert load_scene(folder).warnings == ()


def test_colmaps_own_name_comes_first(tmp_path: Path):
    folder = colmap_with_masks(tmp_path, "masks/a_0.png", "masks/a_0.png.png")
    assert masks_of(folder) == {"a_0.png": "masks/a_0.png.png"}


@pytest.mark.parametrize("place", ["motion_masks", "mask", "masks_2", "images/masks"])
def test_other_folders_hold_no_masks(tmp_path: Path, place: str):
    folder = colmap_with_masks(tmp_path, f"{place}/a_0.png", f"{place}/a_0.png.png")
    assert masks_of(folder) == {}
    assert load_scene(folder).warnings == ()


def test_images_without_a_mask_are_told(tmp_path: Path):
    (warning,) = load_scene(colmap_with_masks(tmp_path, "masks/a_0.png.png")).warnings
    assert "2 of 3 images have no mask" in warning
    assert "first a_2.png; its mask is named a_2.png.png or as the image" in warning


def nerfstudio_with_mask(folder: Path, mask: np.ndarray, of_all: bool = False, lens: Any = SMALL) -> Path:
    content = nerfstudio_json(2, lens)
    (content if of_all else content["frames"][1])["mask_path"] = "masks/m.png"
    folder = layouts.write_nerfstudio(folder, lens, content=content)
    (folder / "masks").mkdir(exist_ok=True)
    write_pixels(folder / "masks" / "m.png", mask)
    return folder


def test_a_mask_is_of_one_frame_or_of_all(tmp_path: Path):
    white = flat(255, SMALL)
    for of_all, count in ((False, 1), (True, 2)):
        splits = load_scene(nerfstudio_with_mask(tmp_path, white, of_all)).splits
        assert sum(frame.mask_path is not None for split in splits.values() for frame in split) == count
    without = load_scene(tmp_path, masks=False)
    assert {frame.mask_path for split in without.splits.values() for frame in split} == {None}
    assert {frame.load_mask() is None for split in without.splits.values() for frame in split} == {True}


WRONG: list[tuple[Callable[[Path], Path], str]] = [
    (lambda folder: nerfstudio_with_mask(folder, flat(255, SMALL)[:12]), r"m\.png: `mask` is 32×12, but .* is 32×24"),
    (lambda folder: nerfstudio_with_mask(folder, flat(255, LENS)), r"m\.png: `mask` is 320×240, but .* is 32×24: both"),
    (lambda folder: colmap_with_masks(folder, "masks/a_0.png", size=SMALL), r"`mask` is 32×24, but .* is 320×240"),
]


@pytest.mark.parametrize(("write", "message"), WRONG)
def test_a_mask_of_another_size_is_refused(tmp_path: Path, write: Callable[[Path], Path], message: str):
    with pytest.raises(DatasetInvalid, match=message):
        load_scene(write(tmp_path))


@pytest.mark.parametrize("name", ["none.png", r"masks\none.png", 3, "/masks/m.png"])
def test_a_missing_mask_is_refused(tmp_path: Path, name: Any):
    folder = nerfstudio_with_mask(tmp_path, flat(255, SMALL))
    content = json.loads((folder / "transforms.json").read_text())
    content["frames"][0]["mask_path"] = name
    (folder / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(
        DatasetInvalid, match=r"`frames\[0\]\.mask_path` (names .*there is no such file|must be a file na)"
    ):
        load_scene(folder)


def frame_with(folder: Path, mask: np.ndarray, lens: Any, size: int | None = None) -> Frame:
    (frame,) = load_scene(nerfstudio_with_mask(folder, mask, lens=lens), size).splits["train"]
    return frame


def test_a_black_mask_is_refused_when_it_is_read(tmp_path: Path):
    frame = frame_with(tmp_path, flat(0, SMALL), SMALL)
    with pytest.raises(
        DatasetInvalid, match=r"m\.png: `mask` leaves no pixel of .*f_01\.png at 32×24: white pixels cou"
    ):
        frame.load_mask()


def test_a_reduced_pixel_counts_if_all_of_its_pixels_do(tmp_path: Path):
    mask = flat(255, SMALL)
    mask[5, 9] = 0
    frame = frame_with(tmp_path, mask, SMALL, 16)
    wanted = np.ones((12, 16), bool)
    wanted[2, 4] = False
    assert (frame.load_mask() == wanted).all()
    cache, whole = ImageCache(), frame_with(tmp_path, mask, SMALL)
    assert (cache.mask(whole) == (mask[..., 0] > 0)).all()
    assert (cache.half_mask(whole) == wanted).all()
    assert cache.rgba(whole).shape == (24, 32, 4)  # a mask and its image don't replace each other
    unmasked = load_scene(tmp_path).splits["test"][0]
    assert cache.mask(unmasked) is None
    assert cache.half_mask(unmasked) is None


@pytest.mark.parametrize("name", ["barrel", "pincushion"])
@pytest.mark.parametrize("size", [None, 160])
def test_a_mask_is_undistorted_as_its_image_is(tmp_path: Path, name: str, size: int | None):
    mask = np.zeros((240, 320, 3), np.uint8)
    mask[20:200, 30:250] = 255
    frame = frame_with(tmp_path, mask, LENSES[name], size)
    frame.image_path.unlink()
    write_pixels(frame.image_path, mask)
    assert (frame.load_mask() == (frame.load_rgba()[..., 0] == 255)).all()
    assert frame.load_rgba()[..., 0].max() == 255


@pytest.mark.parametrize("layout", ["transforms.json", "transforms_train.json"])
def test_instant_ngps_masks_are_white_where_pixels_do_not_count(tmp_path: Path, layout: str):
    folder = layouts.write_nerfstudio(tmp_path, SMALL, content=nerfstudio_json(2, SMALL))
    (folder / "transforms.json").rename(folder / layout)
    mask = flat(0, SMALL)
    mask[3:9] = 255
    write_pixels(folder / "images" / "dynamic_mask_f_01.png", mask)
    frames = [frame for split in load_scene(folder).splits.values() for frame in split]
    masks = {frame.image_path.name: frame.load_mask() for frame in frames}
    assert masks["f_00.png"] is None
    assert (masks["f_01.png"] == (mask[..., 0] == 0)).all()


@pytest.mark.parametrize("size", [None, 160])
def test_pixels_that_the_stored_image_does_not_show_do_not_count(tmp_path: Path, size: int | None):
    lens = LENSES["pincushion"]
    frame = load_scene(layouts.write_nerfstudio(tmp_path, lens), size, masks=False).splits["train"][0]
    mask, camera, cache = frame.load_mask(), frame.camera, ImageCache()
    assert mask is not None
    for row, column in np.argwhere(np.ones_like(mask))[::13]:
        u, v = lens.pixel((column + 0.5 - camera.cx) / camera.fx, (row + 0.5 - camera.cy) / camera.fy, 1.0)
        assert mask[row, column] == (0 <= u <= lens.width and 0 <= v <= lens.height)
    assert (cache.mask(frame) == mask).all()
    half = cache.half_mask(frame)
    assert half is not None
    assert 0.8 < half.mean() <= mask.mean() < 1


def test_a_mask_and_the_border_of_the_image_both_count(tmp_path: Path):
    mask = flat(255, LENS)
    mask[:60] = 0
    frame = frame_with(tmp_path, mask, LENSES["pincushion"])
    own, border = frame.load_own_mask(), load_scene(tmp_path, masks=False).splits["train"][0].load_mask()
    assert own is not None
    assert border is not None
    assert (frame.load_mask() == (own & border)).all()


def test_images_that_show_all_have_no_mask(tmp_path: Path):
    frame = load_scene(layouts.write_nerfstudio(tmp_path, LENSES["barrel"])).splits["train"][0]
    assert frame.load_mask() is None
    assert ImageCache().mask(frame) is None

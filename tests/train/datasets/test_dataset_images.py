"""Images: reading, downscaling and compositing over a background."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
from PIL import Image

from msdgs_train.datasets import DatasetInvalid, composite, load_scene
from msdgs_train.datasets.common.images import ImageSize, read_rgba, read_size, resize_area, write_png
from tests.support.tolerances import assert_close
from tests.train.datasets.jpegs import jpeg, ultra_hdr
from tests.train.datasets.layouts import write_nerfstudio
from tests.train.datasets.lens import Lens


def image(seed: int, width: int, height: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, size=(height, width, 4), dtype=np.uint8)


def area_mean_by_loops(rgba: np.ndarray, width: int, height: int) -> np.ndarray:
    """The area mean by loops over all overlapping pixels; [height, width, 4] float64."""
    old_height, old_width, _ = rgba.shape
    result = np.zeros((height, width, 4))
    for i in range(height):
        for j in range(width):
            weight, alpha, color = 0.0, 0.0, np.zeros(3)
            for y in range(old_height):
                for x in range(old_width):
                    down = min((i + 1) * old_height / height, y + 1) - max(i * old_height / height, y)
                    across = min((j + 1) * old_width / width, x + 1) - max(j * old_width / width, x)
                    area = max(down, 0.0) * max(across, 0.0)
                    weight += area
                    alpha += area * rgba[y, x, 3]
                    color += area * float(rgba[y, x, 3]) * rgba[y, x, :3]
            result[i, j] = [*(color / alpha if alpha else np.zeros(3)), alpha / weight]
    return result


@pytest.mark.parametrize(("width", "height"), [(6, 4), (5, 4), (4, 3), (7, 7), (1, 1), (12, 1)])
def test_reduction_is_the_mean_over_the_covered_area(width: int, height: int):
    rgba = image(width, 12, 8)
    rgba[:3, :5, 3] = 0
    assert_close(resize_area(rgba, width, height), area_mean_by_loops(rgba, width, height), "rounded_to_8bit")


@pytest.mark.parametrize("alpha", [255, 3])
def test_halves_are_rounded_up(alpha: int):
    lower = np.arange(255, dtype=np.uint8)[None, :, None].repeat(4, axis=2)
    lower[..., 3] = alpha
    upper = lower + np.array([1, 1, 1, 0], np.uint8)
    reduced = resize_area(np.tile(np.concatenate([lower, upper]), (3, 1, 1)), 255, 3)
    assert (reduced == upper).all()


@pytest.mark.parametrize(("side", "half"), [(98, 49), (196, 98), (800, 400)])
def test_transparent_areas_beside_opaque_ones_are_black(side: int, half: int):
    rgba = np.zeros((side, side, 4), np.uint8)
    rgba[np.arange(side) // 2 % 2 == 0] = 255
    reduced = resize_area(rgba, half, half)
    assert (reduced == rgba[::2, ::2]).all()
    assert (resize_area(rgba.swapaxes(0, 1), half, half) == reduced.swapaxes(0, 1)).all()


def test_the_same_size_changes_nothing():
    rgba = image(0, 12, 8)
    rgba[:3, :5, 3] = 0
    assert (resize_area(rgba, 12, 8) == rgba).all()


def test_reducing_and_compositing_commute():
    """Averaging straight colors without their alpha would give a dark rim."""
    rgba = image(3, 40, 20)
    background = (0.9, 0.3, 0.1)
    first_laid = composite(rgba, background).reshape(10, 2, 20, 2, 3).mean(axis=(1, 3))
    assert_close(composite(resize_area(rgba, 20, 10), background), first_laid, "composite_of_8bit")


def test_compositing_by_straight_alpha():
    rgba = np.array([[[255, 0, 0, 255], [255, 0, 0, 0], [255, 0, 51, 102]]], np.uint8)
    background = (0.0, 1.0, 0.5)
    got = composite(rgba, background)
    assert got.dtype == np.float32
    assert_close(got, [[[1, 0, 0], background, [0.4, 0.6, 0.38]]], "float32.relative")


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_all_channel_layouts_become_rgba(tmp_path: Path, channels: int):
    path = tmp_path / "image.png"
    pixels = image(channels, 5, 3)[..., :channels].copy()
    write_png(path, pixels)
    rgba = read_rgba(path)
    assert read_size(path) == (5, 3)
    assert (rgba[..., :3] == (pixels[..., :3] if channels >= 3 else pixels[..., :1])).all()
    assert (rgba[..., 3] == (pixels[..., -1] if channels in (2, 4) else 255)).all()


def test_sixteen_bits_are_read_as_eight(tmp_path: Path):
    path = tmp_path / "image.png"
    writer = oiio.ImageOutput.create(str(path))
    assert writer
    writer.open(str(path), oiio.ImageSpec(2, 1, 3, "uint16"))
    writer.write_image(np.array([[[0, 257, 65535], [257 * 100, 257 * 200, 257 * 201]]], np.uint16))
    writer.close()
    assert read_rgba(path).tolist() == [[[0, 1, 255, 255], [100, 200, 201, 255]]]


KINDS = {"baseline": {}, "progressive": {"progressive": True}, "with restarts": {"restart_marker_blocks": 3}}


@pytest.mark.parametrize("kind", KINDS)
def test_a_jpeg_that_is_cut_off_is_refused(tmp_path: Path, kind: str):
    content = jpeg(image(0, 64, 48)[..., :3], comment=b"\xff\xd9", **KINDS[kind])
    path = tmp_path / "image.jpg"
    for length in range(len(content) // 2, len(content), 97):
        path.write_bytes(content[:length])
        with pytest.raises(DatasetInvalid, match=r"image\.jpg: `image` is cut off: copy it again"):
            read_rgba(path)
    for after in (b"", b"\0" * 9, b"\xff\xd8 another image or a video"):
        path.write_bytes(content + after)
        assert read_rgba(path).shape == (48, 64, 4)


@pytest.mark.parametrize("ending", ["webp", "tif", "bmp", "gif"])
def test_other_images_that_are_cut_off_are_refused(tmp_path: Path, ending: str):
    path = tmp_path / f"image.{ending}"
    Image.fromarray(image(0, 64, 48)[..., :3]).save(path)
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(DatasetInvalid, match="copy it again"):
        read_rgba(path)


def test_of_ultra_hdr_the_image_for_usual_screens_is_read(tmp_path: Path):
    pixels = np.indices((48, 64, 3)).sum(axis=0).astype(np.uint8)
    (tmp_path / "usual.jpg").write_bytes(jpeg(pixels))
    (tmp_path / "hdr.jpg").write_bytes(ultra_hdr(pixels))
    assert read_size(tmp_path / "hdr.jpg") == (64, 48)
    np.testing.assert_array_equal(read_rgba(tmp_path / "hdr.jpg"), read_rgba(tmp_path / "usual.jpg"))


@pytest.mark.parametrize(
    ("stated", "copies", "others"),
    [
        ((1920, 1080), [(1920, 1080), (192, 108), (3840, 2160), (100, 56), (100, 57)], [(1920, 1088), (192, 109)]),
        ((1080, 1920), [(108, 192), (56, 100)], [(1080, 1919), (108, 190), (1088, 1920)]),
        ((1297, 843), [(324, 210), (324, 211), (325, 211), (648, 421)], [(324, 212), (320, 210), (0, 0)]),
    ],
)
def test_sizes_of_copies_are_rounded_to_pixels(stated: Any, copies: Any, others: Any):
    assert [size for size in (*copies, *others) if ImageSize(*stated).has_shape_of(ImageSize(*size))] == copies


@pytest.mark.parametrize(
    ("orientation", "size", "states_size", "is_told"),
    [(3, (32, 24), True, 1), (6, (32, 24), True, 0), (6, (24, 24), True, 1), (6, (32, 24), False, 1)],
)
def test_images_that_are_shown_turned_are_told(
    tmp_path: Path, orientation: int, size: Any, states_size: bool, is_told: int
):
    lens = Lens(fx=30.0, fy=30.0, cx=size[0] / 2, cy=size[1] / 2, width=size[0], height=size[1])
    frame = load_scene(write_nerfstudio(tmp_path, lens)).splits["train"][0]
    exif = Image.Exif()
    exif[0x0112] = orientation
    frame.image_path.write_bytes(jpeg(np.zeros((*size[::-1], 3), np.uint8), exif=exif))
    if not states_size:
        contents = json.loads((tmp_path / "transforms.json").read_text())
        for entry in (contents, *contents["frames"]):
            for name in ("w", "h"):
                entry.pop(name, None)
        (tmp_path / "transforms.json").write_text(json.dumps(contents))
    told = [text for text in load_scene(tmp_path).warnings if "1 of 2 images" in text and "EXIF" in text]
    assert len(told) == is_told

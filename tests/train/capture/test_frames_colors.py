"""Videos of other bits, ranges, matrices, primaries and transfer functions, and images with ICC profiles, against
formulas in float64."""

import struct
from itertools import product
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from PIL import Image, ImageCms

from msdgs_train.capture.image_source import read_image
from msdgs_train.datasets.common.images import read_rgba
from msdgs_train.datasets.common.video_colors import HLG, KNEE, PQ, as_srgb

LUMA = {5: (0.299, 0.114), 1: (0.2126, 0.0722), 9: (0.2627, 0.0593)}
"""Weights of red and blue by the matrix's number: BT.601, BT.709, BT.2020."""
BT2020_TO_BT709 = [[1.660491, -0.587641, -0.072850], [-0.124550, 1.132900, -0.008349], [-0.018151, -0.100579, 1.118730]]
"""BT.2087."""
P3_TO_BT709 = [[1.224940, -0.224940, 0], [-0.042057, 1.042057, 0], [-0.019638, -0.078636, 1.098274]]

PRIMARIES = (b"rXYZ", b"gXYZ", b"bXYZ")
"""Names in an ICC profile."""


def frame(layout: str, yuv: tuple[int, ...], **colors: int) -> Any:
    """A frame of one color."""
    made = av.VideoFrame(16, 16, layout)
    for name, value in colors.items():
        setattr(made, name, value)
    for plane, value in zip(made.planes, yuv, strict=True):
        dtype = np.uint16 if layout.endswith("le") else np.uint8
        plane.update(np.full(plane.buffer_size // np.dtype(dtype).itemsize, value, dtype).tobytes())
    return made


def rgb(yuv: tuple[int, ...], bits: int, is_full: bool, matrix: int) -> np.ndarray:
    """Values in [0, 1] of ITU's equations."""
    unit, most = 1 << (bits - 8), (1 << bits) - 1
    y, u, v = yuv[0] - (0 if is_full else 16 * unit), yuv[1] - 128 * unit, yuv[2] - 128 * unit
    y, u, v = (y / most, u / most, v / most) if is_full else (y / 219 / unit, u / 224 / unit, v / 224 / unit)
    red, blue = LUMA[matrix]
    r, b = y + 2 * (1 - red) * v, y + 2 * (1 - blue) * u
    return np.clip([r, (y - red * r - blue * b) / (1 - red - blue), b], 0, 1)


def encoded(light: np.ndarray) -> np.ndarray:
    light = np.clip(light, 0, 1)
    return 255 * np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def decoded(value: np.ndarray) -> np.ndarray:
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def compressed(nits: np.ndarray) -> np.ndarray:
    """Light relative to diffuse white, the largest component by the Möbius function through KNEE with slope 1, that
    sends the peak to 1: found by its conditions, not by the closed form."""
    light, peak = nits / 203, 1000 / 203
    largest = light.max()
    if largest <= KNEE:
        return light
    # f(x) = KNEE + (x - KNEE) / (1 + c (x - KNEE)); f(peak) = 1
    c = (1 / (1 - KNEE)) - 1 / (peak - KNEE)
    return light * (KNEE + (largest - KNEE) / (1 + c * (largest - KNEE))) / largest


def pq(value: np.ndarray) -> np.ndarray:
    """cd/m², SMPTE ST 2084."""
    root = value ** (32 / 2523)
    return 10000 * (np.maximum(root - 0.8359375, 0) / (18.8515625 - 18.6875 * root)) ** (16384 / 2610)


def hlg(value: np.ndarray) -> np.ndarray:
    """cd/m² on a display of 1000, BT.2100."""
    scene = np.where(value <= 0.5, value**2 / 3, (np.exp((value - 0.55991073) / 0.17883277) + 0.28466892) / 12)
    return 1000 * (scene @ [0.2627, 0.6780, 0.0593]) ** 0.2 * scene


COLORS = [(0.47, 0.42, 0.6), (0.2, 0.5, 0.5), (0.8, 0.45, 0.52), (0.9, 0.5, 0.5)]


@pytest.mark.parametrize(("bits", "layout"), [(8, "yuv420p"), (10, "yuv420p10le"), (12, "yuv444p12le")])
def test_bits_ranges_and_matrices_of_sdr(bits: int, layout: str):
    for color, is_full, matrix in product(COLORS, (False, True), LUMA):
        yuv = tuple(round(value * (1 << bits)) for value in color)
        made = frame(layout, yuv, colorspace=matrix, color_range=2 if is_full else 1, color_primaries=1)
        wanted = 255 * rgb(yuv, bits, is_full, matrix)
        assert np.abs(as_srgb(made, 8, 8) - wanted).max() <= 1.5


@pytest.mark.parametrize(("primaries", "matrix"), [(9, BT2020_TO_BT709), (12, P3_TO_BT709)])
def test_wide_primaries_become_those_of_srgb_and_gray_stays(primaries: int, matrix: Any):
    for color in COLORS:
        yuv = tuple(round(value * 1024) for value in color)
        made = frame("yuv420p10le", yuv, colorspace=9, color_range=1, color_primaries=primaries, color_trc=1)
        value = rgb(yuv, 10, False, 9)
        assert np.abs(as_srgb(made, 8, 8) - encoded(np.array(matrix) @ decoded(value))).max() <= 1.5
        if color[1:] == (0.5, 0.5):
            assert np.abs(as_srgb(made, 8, 8) - 255 * value).max() <= 1.5


@pytest.mark.parametrize(("transfer", "light"), [(PQ, pq), (HLG, hlg)])
def test_hdr_becomes_srgb(transfer: int, light: Any):
    for color in COLORS:
        yuv = tuple(round(value * 1024) for value in color)
        made = frame("yuv420p10le", yuv, colorspace=9, color_range=1, color_primaries=9, color_trc=transfer)
        wanted = encoded(np.array(BT2020_TO_BT709) @ compressed(light(rgb(yuv, 10, False, 9))))
        assert np.abs(as_srgb(made, 8, 8) - wanted).max() <= 2.5


def test_hdr_is_compressed_without_steps_and_its_peak_is_white():
    levels = range(64, 941, 4)
    made = [frame("yuv444p10le", (y, 512, 512), colorspace=9, color_range=1, color_trc=HLG) for y in levels]
    gray = [int(as_srgb(each, 8, 8)[4, 4, 1]) for each in made]
    assert gray[0] == 0
    assert gray[-1] == 255
    assert all(0 <= step <= 5 for step in np.diff(gray))


def display_p3() -> bytes:
    """The ICC profile of sRGB with the primaries of P3."""
    profile = bytearray(ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes())
    places = [struct.unpack(">I", profile[at + 4 : at + 8])[0] + 8 for at in map(profile.index, PRIMARIES)]
    to_xyz = np.array([struct.unpack(">3i", profile[place : place + 12]) for place in places]).T
    for place, column in zip(places, (to_xyz @ P3_TO_BT709).T, strict=True):
        profile[place : place + 12] = struct.pack(">3i", *np.round(column).astype(int))
    return bytes(profile)


def shown(pixels: np.ndarray, file: Path, profile: bytes | None) -> np.ndarray:
    """What is read of an image that is written with a profile."""
    Image.fromarray(pixels).save(file, icc_profile=profile)
    return read_image(file)


@pytest.mark.parametrize("ending", ["png", "tif"])
def test_images_are_converted_from_their_icc_profile(tmp_path: Path, ending: str):
    pixels = np.array([list(product((60, 150, 230), repeat=3))], np.uint8)
    found = shown(pixels, tmp_path / f"a.{ending}", display_p3()).astype(float)
    wanted = encoded(decoded(pixels / 255) @ np.transpose(P3_TO_BT709))
    assert np.abs(wanted - pixels).max() > 20
    assert np.abs(found - wanted).max() <= 2  # lcms computes with 8 bits


def test_datasets_are_converted_too_and_alpha_stays(tmp_path: Path):
    rgba = np.random.default_rng(0).integers(0, 256, (8, 9, 4), np.uint8)
    Image.fromarray(rgba).save(tmp_path / "a.png", icc_profile=display_p3())
    found = read_rgba(tmp_path / "a.png")
    np.testing.assert_array_equal(found[..., 3], rgba[..., 3])
    np.testing.assert_array_equal(found[..., :3], shown(rgba[..., :3], tmp_path / "b.png", display_p3()))


def test_a_profile_of_srgb_changes_nothing(tmp_path: Path):
    pixels = np.random.default_rng(0).integers(0, 256, (64, 90, 3), np.uint8)
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    np.testing.assert_array_equal(shown(pixels, tmp_path / "a.png", profile), pixels)


def test_images_without_a_profile_of_rgb_are_taken_for_srgb(tmp_path: Path):
    pixels = np.random.default_rng(0).integers(0, 256, (8, 9, 3), np.uint8)
    lab = ImageCms.ImageCmsProfile(ImageCms.createProfile("LAB")).tobytes()
    for name, profile in {"none": None, "of Lab": lab, "damaged": b"-" * 200}.items():
        np.testing.assert_array_equal(shown(pixels, tmp_path / f"{name}.tif", profile), pixels)

"""Encoders: decoded images equal the original to the format's precision."""

import os
from dataclasses import replace

import numpy as np
import OpenImageIO as oiio
import pytest

from msdgs_serve.imaging import FORMATS, EncodingFailed, Image, encode, srgb_to_linear
from msdgs_serve.imaging.formats import ImageFormat
from msdgs_serve.scene import Camera, InvalidInput
from msdgs_serve.scene.camera import CameraModel, orbit
from tests.support.images import decode, linear_to_srgb, psnr

WIDTH, HEIGHT = 40, 30
BACKGROUND = np.array([0.2, 0.5, 1.0], np.float32)


def make_image(transparent: bool = False, width: int = WIDTH, height: int = HEIGHT) -> Image:
    """A smooth color ramp under a disc of soft coverage; the corners are empty."""
    y, x = np.mgrid[0:height, 0:width] / np.array([height, width]).reshape(2, 1, 1)
    alpha = np.clip(1.3 - 4 * ((x - 0.5) ** 2 + (y - 0.5) ** 2), 0, 1).astype(np.float32)
    straight = np.stack([x, y, 1 - x * y], axis=2).astype(np.float32)
    rgb = straight * alpha[..., None] + (1 - alpha[..., None]) * (0 if transparent else BACKGROUND)
    depth = np.where(alpha > 0, 3 + x, np.inf)
    return Image(rgb.astype(np.float32), alpha, depth.astype(np.float32), transparent)


def test_png_holds_the_nearest_of_256_levels():
    image = make_image()
    pixels, _ = decode(encode(image, "png"), "png")
    assert pixels.shape == (HEIGHT, WIDTH, 3)
    assert np.abs(pixels / 255 - image.rgb).max() <= 0.5 / 255 + 1e-6


@pytest.mark.parametrize("image_format", ["png", "webp"])
def test_transparent_images_hold_straight_alpha(image_format: ImageFormat):
    image = make_image(transparent=True)
    pixels, _ = decode(encode(image, image_format), image_format)
    assert pixels.shape == (HEIGHT, WIDTH, 4)
    np.testing.assert_array_less(np.abs(pixels[..., 3] / 255 - image.alpha), 0.5 / 255 + 1e-6)
    if image_format == "png":
        covered = image.alpha > 0
        assert not covered.all()
        straight = image.rgb[covered] / image.alpha[covered][:, None]
        np.testing.assert_array_less(np.abs(pixels[covered][:, :3] / 255 - straight), 0.5 / 255 + 1e-5)
        assert (pixels[~covered] == 0).all()


@pytest.mark.parametrize("image_format", ["jpeg", "webp"])
def test_lossy_formats_come_close_and_closer_with_quality(image_format: ImageFormat):
    image = make_image(width=64, height=64)
    errors = []
    for quality in (20, 95):
        pixels, _ = decode(encode(image, image_format, quality), image_format)
        assert pixels.shape == (64, 64, 3)
        errors.append(psnr(pixels / 255, image.rgb))
    assert errors[0] < errors[1]
    assert errors[1] > 35


def test_exr_holds_linear_premultiplied_color_and_depth():
    image = make_image(transparent=True)
    pixels, spec = decode(encode(image, "exr"), "exr")
    assert pixels.dtype == np.float32
    assert spec.channelnames == ("R", "G", "B", "A", "Z")
    alpha = image.alpha[..., None]
    straight = np.divide(image.rgb, alpha, out=np.zeros_like(image.rgb), where=alpha > 0)
    np.testing.assert_allclose(pixels[..., :3], srgb_to_linear(straight) * alpha, atol=1e-6)
    np.testing.assert_array_equal(pixels[..., 3], image.alpha)
    np.testing.assert_array_equal(pixels[..., 4], image.depth)
    assert np.isinf(pixels[..., 4][image.alpha == 0]).all()


@pytest.mark.parametrize("brightness", [1.0, 1.5])
def test_opaque_exr_is_the_display_image_linearised(brightness: float):
    image = make_image()
    image = Image(brightness * image.rgb, image.alpha, image.depth)
    pixels, spec = decode(encode(image, "exr"), "exr")
    assert (pixels[..., 3] == 1).all()
    np.testing.assert_allclose(linear_to_srgb(pixels[..., :3]), image.rgb, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(pixels[..., 4], image.depth)
    assert spec.getattribute("oiio:ColorSpace") == "lin_rec709_scene"
    np.testing.assert_allclose(spec.getattribute("chromaticities")[:2], (0.64, 0.33), rtol=1e-6)
    eight_bits, _ = decode(encode(image, "png"), "png")
    assert (eight_bits[image.rgb > 1] == 255).all()


@pytest.mark.parametrize("model", ["pinhole", "orthographic", "fisheye"])
def test_exr_names_its_camera(model: CameraModel):
    distortion = (0.25, 0.5, 0.0, -1.0) if model == "fisheye" else (0.0, 0.0, 0.0, 0.0)
    pose = orbit(np.array([0.1, 0.2, 0.3]), 4.0, 30, 20, np.array([0.0, 0.0, 1.0]))
    camera = Camera(50.0, 60.0, 18.0, 16.0, WIDTH, HEIGHT, pose, model, distortion)
    _, spec = decode(encode(replace(make_image(), camera=camera, t=0.5), "exr"), "exr")
    assert spec.getattribute("msdgs:camera_model") == model
    assert spec.getattribute("msdgs:distortion") == distortion
    assert spec.getattribute("msdgs:intrinsics") == (50, 60, 18, 16)
    if model == "fisheye":
        assert spec.getattribute("worldToNDC") is None
        return
    to_ndc = np.array(spec.getattribute("worldToNDC")).reshape(4, 4)
    points = np.array([[0.3, -0.2, 0.1], [0.0, 0.5, 1.0]])
    pixels, depths = camera.project(points)
    x, y, z, w = (np.column_stack([points, np.ones(2)]) @ to_ndc).T
    np.testing.assert_allclose(np.column_stack([x / w * WIDTH, y / w * HEIGHT]), pixels, rtol=1e-5)
    np.testing.assert_allclose(z / w, depths if model == "orthographic" else 1 / depths, rtol=1e-5)
    assert np.linalg.matrix_rank(to_ndc) == 4


@pytest.mark.parametrize("image_format", FORMATS)
@pytest.mark.parametrize("size", [(1, 1), (1, 7), (7, 1)])
def test_tiny_images(image_format: ImageFormat, size: tuple[int, int]):
    pixels, _ = decode(encode(make_image(width=size[0], height=size[1]), image_format), image_format)
    assert pixels.shape[:2] == (size[1], size[0])


@pytest.mark.parametrize("image_format", FORMATS)
def test_equal_images_give_equal_bytes(image_format: ImageFormat, monkeypatch: pytest.MonkeyPatch):
    body = encode(make_image(), image_format)
    assert encode(make_image(), image_format) == body
    monkeypatch.delattr(os, "memfd_create")
    assert encode(make_image(), image_format) == body, "through a file on disk"


@pytest.mark.parametrize(
    ("arguments", "field"),
    [
        ((make_image(), "gif"), "format"),
        ((make_image(transparent=True), "jpeg"), "background"),
        ((make_image(), "png", 90), "quality"),
        ((make_image(), "exr", 90), "quality"),
        ((make_image(), "jpeg", 0), "quality"),
        ((make_image(), "webp", 101), "quality"),
        ((make_image(width=16384, height=1), "webp"), "width"),
        ((make_image(width=1, height=16384), "webp"), "height"),
    ],
)
def test_images_that_a_format_cannot_hold_are_refused_by_name(arguments, field):
    with pytest.raises(InvalidInput) as error:
        encode(*arguments)
    assert error.value.field == field


def test_an_error_of_the_writer_is_raised(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(oiio.ImageOutput, "create", lambda _: None)
    with pytest.raises(EncodingFailed, match="png"):
        encode(make_image(), "png")


def test_channels_of_different_sizes_are_refused():
    image = make_image()
    with pytest.raises(InvalidInput) as error:
        Image(image.rgb, image.alpha[1:], image.depth)
    assert error.value.field == "image.alpha"


def test_srgb_transfer_against_known_values_and_back():
    # IEC 61966-2-1: mid grey 0.5 encoded is 0.21404 linear; the function is continuous
    known = srgb_to_linear(np.array([0.0, 0.04045, 0.5, 1.0]))
    np.testing.assert_allclose(known, [0, 0.0031308, 0.2140411, 1], atol=1e-7)
    values = np.linspace(0, 4, 1001)
    np.testing.assert_allclose(linear_to_srgb(srgb_to_linear(values)), values, atol=1e-6)

"""The photometric loss: against torchmetrics, against finite differences, and by its laws."""

from typing import Any

import numpy as np
import pytest
import torch
from torchmetrics.functional.image import structural_similarity_index_measure

from msdgs_serve.scene import InvalidInput
from msdgs_train.losses.photometric import MSE_SCALE, masked_l1, photometric_loss, pooled_l1
from msdgs_train.losses.ssim import RADIUS, ssim
from tests.support.tolerances import assert_close, tolerance


def _pair(seed: int, height: int, width: int, dtype: torch.dtype = torch.float64) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    target = torch.rand(height, width, 3, generator=generator, dtype=dtype)
    return (target + 0.3 * torch.randn(target.shape, generator=generator, dtype=dtype)).clamp(0, 1), target


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_ssim_is_that_of_torchmetrics(dtype: torch.dtype) -> None:
    """With black all around the images, for torchmetrics mirrors them at the border."""
    rgb, target = _pair(0, 40, 31, dtype)
    padded = [torch.nn.functional.pad(v, (0, 0, *4 * [2 * RADIUS])) for v in (rgb, target)]
    expected: Any = structural_similarity_index_measure(
        padded[0].permute(2, 0, 1)[None], padded[1].permute(2, 0, 1)[None], gaussian_kernel=True, data_range=1.0
    )
    assert_close(float(ssim(*padded)), float(expected), f"ssim.{str(dtype).removeprefix('torch.')}")


def test_gradient_agrees_with_finite_differences() -> None:
    rgb, target = _pair(1, 13, 9)
    rgb.requires_grad_(True)
    atol = tolerance("loss_gradient")
    assert torch.autograd.gradcheck(lambda x: ssim(x, target), (rgb,), atol=atol, rtol=0)
    assert torch.autograd.gradcheck(lambda x: photometric_loss(x, target, 0.8), (rgb,), atol=atol, rtol=0, eps=1e-7)


def test_equal_images_have_no_loss() -> None:
    _, target = _pair(2, 20, 20)
    assert float(ssim(target, target)) == pytest.approx(1.0)
    assert float(photometric_loss(target, target, 0.8)) == pytest.approx(0.0, abs=1e-12)


def test_ssim_is_symmetric_and_does_not_know_left_from_right() -> None:
    rgb, target = _pair(3, 17, 23)
    value = float(ssim(rgb, target))
    assert float(ssim(target, rgb)) == pytest.approx(value, rel=1e-12)
    assert float(ssim(rgb.flip(1), target.flip(1))) == pytest.approx(value, rel=1e-12)
    assert float(ssim(rgb.transpose(0, 1), target.transpose(0, 1))) == pytest.approx(value, rel=1e-12)
    assert float(ssim(rgb.flip(2), target.flip(2))) == pytest.approx(value, rel=1e-12)


@pytest.mark.parametrize("shape", [(1, 1), (1, 30), (30, 1), (4, 4), (11, 11)])
def test_images_smaller_than_the_window(shape: tuple[int, int]) -> None:
    rgb, target = _pair(4, *shape)
    rgb.requires_grad_(True)
    photometric_loss(rgb, target, 0.5).backward()
    assert rgb.grad is not None
    assert torch.isfinite(rgb.grad).all()


def test_weight_mixes_the_two_terms() -> None:
    rgb, target = _pair(5, 16, 16)
    l1, dssim = float((rgb - target).abs().mean()), 1 - float(ssim(rgb, target))
    for weight in (0.0, 0.3, 1.0):
        expected = weight * l1 + (1 - weight) * dssim
        assert float(photometric_loss(rgb, target, weight)) == pytest.approx(expected, rel=1e-9)


def test_not_finite_pixels_are_not_hidden() -> None:
    rgb, target = _pair(6, 16, 16)
    rgb[3, 4, 1] = np.nan
    assert torch.isnan(photometric_loss(rgb, target, 0.8))


def test_shapes_that_disagree_are_refused() -> None:
    rgb, target = _pair(7, 16, 16)
    with pytest.raises(InvalidInput, match="`target`"):
        photometric_loss(rgb, target[:-1], 0.8)
    with pytest.raises(InvalidInput, match="`target`"):
        photometric_loss(rgb, target.float(), 0.8)
    with pytest.raises(InvalidInput, match="`rgb`"):
        ssim(rgb[..., 0], target[..., 0])


def test_what_has_moved_away_teaches_nothing_of_what_stands_still() -> None:
    target = torch.full((20, 30, 3), 0.5)
    rgb = (target + 0.1).requires_grad_()
    with torch.no_grad():
        rgb[4, 5] += 0.3
    loss = masked_l1(rgb, target, 0.8)
    (gradient,) = torch.autograd.grad(loss, [rgb])
    elsewhere = torch.ones(20, 30, dtype=torch.bool)
    elsewhere[2:7, 3:8] = False
    assert torch.equal(gradient.any(dim=2), elsewhere)
    assert float(loss.detach()) == pytest.approx(0.8 * 0.1 * float(elsewhere.double().mean()))


@pytest.mark.parametrize("l1_weight", [0.8, 1.0])
def test_squared_errors_take_their_part_of_the_loss(l1_weight: float) -> None:
    rgb, target = torch.rand(2, 20, 30, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    whole, squares = photometric_loss(rgb, target, l1_weight), MSE_SCALE * (rgb - target).square().mean()
    assert float(photometric_loss(rgb, target, l1_weight, 0.3)) == pytest.approx(float(0.7 * whole + 0.3 * squares))
    assert float(photometric_loss(rgb, target, l1_weight, 1.0)) == pytest.approx(float(squares))


def _spot(left: torch.Tensor) -> torch.Tensor:
    """[40, 60, 3] a soft spot 3 pixels wide, `left` of which is its column."""
    rows, columns = torch.arange(40.0)[:, None], torch.arange(60.0)
    return torch.exp(-((rows - 20) ** 2 + (columns - left) ** 2) / 2).expand(3, -1, -1).permute(1, 2, 0)


def test_what_is_far_from_its_place_is_pulled_there_by_blocks() -> None:
    """Pixel by pixel a spot twelve pixels off has nothing to gain by coming nearer."""
    target, place = _spot(torch.tensor(30.0)), torch.tensor(42.0, requires_grad=True)
    (by_pixels,) = torch.autograd.grad(photometric_loss(_spot(place), target, 1.0), [place])
    (by_blocks,) = torch.autograd.grad(pooled_l1(_spot(place), target), [place])
    assert abs(float(by_pixels)) < 1e-6
    assert float(by_blocks) > 1e-4


def test_blocks_of_images_smaller_than_they_are() -> None:
    rgb, target = torch.full((3, 5, 3), 0.75), torch.full((3, 5, 3), 0.5)
    assert float(pooled_l1(rgb, target)) == pytest.approx(3 * 0.25)
    assert float(pooled_l1(target, target)) == 0.0

"""The photometric loss and metrics: against torchmetrics, against finite differences, and by their laws."""

import math
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from torchmetrics.functional.image import peak_signal_noise_ratio, structural_similarity_index_measure

from msdgs_serve.scene import InvalidInput
from msdgs_train.evaluation.metrics import MAX_PSNR, ImageMetrics, image_metrics, mean_metrics, psnr
from msdgs_train.losses.kernels import RADIUS
from msdgs_train.losses.photometric import MSE_SCALE, photometric_loss, ssim
from tests.support.tolerances import assert_close, tolerance


def _pair(seed: int, height: int, width: int, dtype: torch.dtype = torch.float64) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    target = torch.rand(height, width, 3, generator=generator, dtype=dtype)
    return (target + 0.3 * torch.randn(target.shape, generator=generator, dtype=dtype)).clamp(0, 1), target


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_ssim_is_that_of_torchmetrics(dtype: torch.dtype) -> None:
    """With black all around the images, since torchmetrics mirrors them at the border."""
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
    for mse_fraction in (0.0, 0.8, 1.0):
        loss = partial(photometric_loss, target=target, l1_weight=0.8, mse_fraction=mse_fraction)
        assert torch.autograd.gradcheck(loss, (rgb,), atol=atol, rtol=0, eps=1e-7)


def test_ssim_is_symmetric_and_invariant_to_flips() -> None:
    rgb, target = _pair(3, 17, 23)
    pairs = [(target, rgb), *((rgb.flip(axis), target.flip(axis)) for axis in (1, 2))]
    pairs.append((rgb.transpose(0, 1), target.transpose(0, 1)))
    assert [float(ssim(*pair)) for pair in pairs] == pytest.approx([float(ssim(rgb, target))] * 4, rel=1e-12)


@pytest.mark.parametrize("shape", [(1, 1), (1, 30), (30, 1), (4, 4), (11, 11)])
def test_images_smaller_than_the_window(shape: tuple[int, int]) -> None:
    rgb, target = _pair(4, *shape)
    rgb.requires_grad_(True)
    photometric_loss(rgb, target, 0.5).backward()
    assert rgb.grad is not None
    assert torch.isfinite(rgb.grad).all()


@pytest.mark.parametrize("mse_fraction", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("l1_weight", [0.0, 0.3, 0.8, 1.0])
def test_weights_mix_the_three_terms(l1_weight: float, mse_fraction: float) -> None:
    rgb, target = _pair(5, 16, 16)
    l1, dssim = float((rgb - target).abs().mean()), 1 - float(ssim(rgb, target))
    squares = MSE_SCALE * float((rgb - target).square().mean())
    expected = (1 - mse_fraction) * (l1_weight * l1 + (1 - l1_weight) * dssim) + mse_fraction * squares
    assert float(photometric_loss(rgb, target, l1_weight, mse_fraction)) == pytest.approx(expected, rel=1e-9)


def test_not_finite_pixels_are_not_hidden() -> None:
    rgb, target = _pair(6, 16, 16)
    rgb[3, 4, 1] = np.nan
    assert torch.isnan(photometric_loss(rgb, target, 0.8))


def test_shapes_that_disagree_are_refused() -> None:
    rgb, target = _pair(7, 16, 16)
    for other in (target[:-1], target.float()):
        with pytest.raises(InvalidInput, match="`target`"):
            photometric_loss(rgb, other, 0.8)
    with pytest.raises(InvalidInput, match="`rgb`"):
        ssim(rgb[..., 0], target[..., 0])


def test_psnr_is_that_of_torchmetrics() -> None:
    rgb, target = _pair(0, 20, 30)
    expected = peak_signal_noise_ratio(rgb, target, data_range=1.0)
    assert_close(psnr(rgb, target), float(expected), "psnr.relative")


def test_equal_images_have_no_loss_and_the_highest_psnr_and_nan_stays() -> None:
    drawn = torch.rand(4, 4, 3, dtype=torch.float64)
    assert float(photometric_loss(drawn, drawn, 0.8)) == pytest.approx(0.0, abs=1e-12)
    assert psnr(drawn, drawn) == MAX_PSNR
    assert math.isnan(psnr(drawn * math.nan, drawn))


def test_renderings_are_clamped_first() -> None:
    white = torch.ones(12, 12, 3)
    assert image_metrics(white + 0.5, white) == pytest.approx((MAX_PSNR, 1.0))


def test_mean_is_of_psnrs() -> None:
    assert mean_metrics([ImageMetrics(20, 0.5), ImageMetrics(40, 0.7)]) == pytest.approx((30, 0.6))

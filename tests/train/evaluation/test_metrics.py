"""PSNR and SSIM as reported."""

import math

import pytest
import torch
from torchmetrics.functional.image import peak_signal_noise_ratio

from msdgs_train.evaluation.metrics import MAX_PSNR, ImageMetrics, image_metrics, mean_metrics, psnr
from tests.support.tolerances import assert_close


def test_psnr_is_that_of_torchmetrics() -> None:
    generator = torch.Generator().manual_seed(0)
    rgb, target = (torch.rand(20, 30, 3, generator=generator, dtype=torch.float64) for _ in range(2))
    expected = peak_signal_noise_ratio(rgb, target, data_range=1.0)
    assert_close(psnr(rgb, target), float(expected), "psnr.relative")


def test_a_tenth_everywhere_is_20_db() -> None:
    assert psnr(torch.full((5, 5, 3), 0.6), torch.full((5, 5, 3), 0.5)) == pytest.approx(20.0, abs=1e-4)


def test_equal_images_get_the_cap_and_nan_stays() -> None:
    drawn = torch.rand(4, 4, 3)
    assert psnr(drawn, drawn) == MAX_PSNR
    assert math.isnan(psnr(drawn * math.nan, drawn))


def test_renderings_are_clamped_first() -> None:
    white = torch.ones(12, 12, 3)
    assert image_metrics(white + 0.5, white) == pytest.approx((MAX_PSNR, 1.0))


def test_mean_is_of_psnrs() -> None:
    assert mean_metrics([ImageMetrics(20, 0.5), ImageMetrics(40, 0.7)]) == pytest.approx((30, 0.6))

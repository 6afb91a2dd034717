"""PSNR and SSIM of a rendering against its image, as the papers of this field report them."""

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from msdgs_train.losses.photometric import ssim

MAX_PSNR = 100.0
"""Reported for equal images, in dB."""


class ImageMetrics(NamedTuple):
    """Metrics of a rendering against its image."""

    psnr: float  # dB, data range 1
    ssim: float  # at most 1


def psnr(rgb: Tensor, target: Tensor) -> float:
    """Return PSNR in dB of […, 3] pixels with values in [0, 1], over all pixels and channels."""
    return psnr_from_mse(float((rgb - target).double().square().mean()))


def masked_psnr(rgb: Tensor, target: Tensor, mask: np.ndarray) -> float | None:
    """Return PSNR in dB of [H, W, 3] images over the pixels of `mask`, [H, W] bool; None if there are none."""
    inside = torch.from_numpy(mask)
    return psnr_from_mse(float((rgb - target)[inside].double().square().mean())) if mask.any() else None


def psnr_from_mse(mse: float) -> float:
    """Return −10 log10(mse), at most `MAX_PSNR`; NaN stays NaN."""
    return MAX_PSNR if mse <= 10 ** (-MAX_PSNR / 10) else -10 * math.log10(mse)


def image_metrics(rgb: Tensor, target: Tensor, mask: np.ndarray | None = None) -> ImageMetrics:
    """Return PSNR and SSIM of one rendering, clamped to [0, 1] first; both [H, W, 3]. Both are means over the pixels of
    `mask`, [H, W] bool; None: over all."""
    shown = rgb.detach().clamp(0, 1)
    if mask is None:
        return ImageMetrics(psnr(shown, target), float(ssim(shown, target)))
    counts = torch.from_numpy(mask)
    return ImageMetrics(psnr(shown[counts], target[counts]), float(ssim(shown, target, counts)))


def mean_metrics(metrics: list[ImageMetrics]) -> ImageMetrics:
    """Return the mean over images: of PSNR (not the PSNR of the mean error) and of SSIM."""
    count = len(metrics)
    return ImageMetrics(sum(q.psnr for q in metrics) / count, sum(q.ssim for q in metrics) / count)

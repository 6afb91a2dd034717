"""The photometric loss, L = λ L1 + (1 − λ) D-SSIM (equation 13), and its variants for motion and for static parts."""

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

from msdgs_train.losses.ssim import check_pair, ssim

CHANGE_THRESHOLD = 0.25
"""Mean color difference of a pixel from which on an object is assumed to have moved there."""
MSE_SCALE = 4.0
"""Factor of MSE, at which it equals L1 for an error of 0.25."""
BLOCKS = (8, 16, 32)
"""Sizes in pixels of the blocks that `pooled_l1` averages over."""


def photometric_loss(rgb: Tensor, target: Tensor, l1_weight: float, mse_fraction: float = 0.0) -> Tensor:
    """λ L1 + (1 − λ)(1 − SSIM), a scalar (equation 13), of which a fraction may be MSE instead.

    Args:
        rgb: [H, W, 3] the rendering, float32 or float64; the loss is differentiable in it.
        target: [H, W, 3] the image, same dtype, values in [0, 1].
        l1_weight: λ; the field uses 0.8.
        mse_fraction: fraction of MSE; 0 is equation 13, 1 is `MSE_SCALE` times the mean squared error.
    """
    check_pair(rgb, target)
    error = rgb - target
    loss = l1_weight * error.abs().mean()
    if l1_weight < 1.0:
        loss = loss + (1 - l1_weight) * (1 - ssim(rgb, target))
    if mse_fraction == 0.0:
        return loss
    return (1 - mse_fraction) * loss + mse_fraction * MSE_SCALE * error.square().mean()


def pooled_l1(rgb: Tensor, target: Tensor) -> Tensor:
    """L1 of two images, [H, W, 3], averaged over overlapping blocks: a scalar, the sum over `BLOCKS`.

    Pooling gives a gradient at displacements larger than the object, at which L1 of single pixels has none.
    """
    check_pair(rgb, target)
    error = (rgb - target).permute(2, 0, 1)
    widths = [min(width, *error.shape[1:]) for width in BLOCKS]
    return torch.stack([avg_pool2d(error, width, max(width // 4, 1)).abs().mean() for width in widths]).sum()


def masked_l1(rgb: Tensor, target: Tensor, l1_weight: float) -> Tensor:
    """λ L1 over the pixels in which two images, [H, W, 3], agree: no pixel in the 5×5 around them differs by
    `CHANGE_THRESHOLD` or more."""
    check_pair(rgb, target)
    error = (rgb - target).abs()
    worst = max_pool2d(error.detach().mean(dim=2)[None], kernel_size=5, stride=1, padding=2)[0]
    return l1_weight * (error * (worst < CHANGE_THRESHOLD)[:, :, None]).mean()

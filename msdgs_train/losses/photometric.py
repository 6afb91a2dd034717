"""The photometric loss, L = λ L1 + (1 − λ) D-SSIM (equation 13)."""

from torch import Tensor

from msdgs_train.losses.ssim import check_pair, ssim

MSE_SCALE = 4.0
"""Factor of MSE, at which it equals L1 for an error of 0.25."""


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

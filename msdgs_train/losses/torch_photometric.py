"""The photometric loss by torch's operations, for devices without kernels.

Loss and gradient are computed together, with two separable blurs, so that autograd records none of their forty images.
"""

import functools
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import conv2d

from msdgs_train.losses.kernels import C1, C2, RADIUS, TAPS


class TorchPhotometric(torch.autograd.Function):
    """The weighted sum of L1, MSE and 1 − SSIM; arguments as of `photometric._Photometric`."""

    @staticmethod
    def forward(ctx: Any, rgb: Tensor, target: Tensor, l1: float, mse: float, dssim: float) -> Tensor:
        error = rgb - target
        loss = l1 * error.abs().mean() + mse * error.square().mean()
        gradient = error.sign().mul_(l1).add_(error, alpha=2 * mse)
        if dssim:
            similarity, slope = _ssim_and_gradient(*(image.permute(2, 0, 1) for image in (rgb, target)))
            loss = loss + dssim * (1 - similarity)
            gradient.sub_(slope.permute(1, 2, 0), alpha=dssim)
        ctx.save_for_backward(gradient.div_(rgb.numel()))
        return loss

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        return grad * ctx.saved_tensors[0], None, None, None, None


def _ssim_and_gradient(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """The mean of SSIM of images [3, H, W], and the gradient of its sum in x."""
    mx, xx, xy, my, yy = _blur(torch.cat([x, x * x, x * y, y, y * y])).split(len(x))
    top1, top2 = 2 * mx * my + C1, 2 * (xy - mx * my) + C2
    inverse1 = (mx * mx + my * my + C1).reciprocal_()
    inverse2 = (xx - mx * mx + yy - my * my + C2).reciprocal_()
    scale = inverse1 * inverse2
    value = top1 * top2 * scale
    by_mx = 2 * (my * (top2 - top1) * scale - mx * value * (inverse1 - inverse2))
    by_xx, by_xy = -value * inverse2, 2 * top1 * scale
    by_mx, by_xx, by_xy = _blur(torch.cat([by_mx, by_xx, by_xy])).split(len(x))  # a blur is its own transpose
    return value.mean(), by_mx + 2 * x * by_xx + y * by_xy


def _blur(maps: Tensor) -> Tensor:
    """[M, H, W] blurred by the window of SSIM, with zeros beyond the border. TF32, which convolutions use by default,
    has too few digits for variances."""
    taps = _taps(maps.dtype, maps.device)
    with torch.backends.cudnn.flags(enabled=True, allow_tf32=False):
        rows = conv2d(maps[:, None], taps[None, None, None], padding=(0, RADIUS))
        return conv2d(rows, taps[None, None, :, None], padding=(RADIUS, 0))[:, 0]


@functools.cache
def _taps(dtype: torch.dtype, device: torch.device) -> Tensor:
    return torch.from_numpy(TAPS).to(device, dtype)

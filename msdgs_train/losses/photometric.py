"""The photometric loss, L = λ L1 + (1 − λ) D-SSIM (equation 13)."""

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.layers import arrays
from msdgs_train.layers.arrays import to_array
from msdgs_train.losses.kernels import RADIUS, TAPS, loss_sums_and_gradient
from msdgs_train.losses.torch_photometric import TorchPhotometric

MSE_SCALE = 4.0
"""Factor of MSE, at which it equals L1 for an error of 0.25."""


def photometric_loss(
    rgb: Tensor, target: Tensor, l1_weight: float, mse_fraction: float = 0.0, mask: Tensor | None = None
) -> Tensor:
    """λ L1 + (1 − λ)(1 − SSIM), a scalar (equation 13), of which a fraction may be MSE instead.

    Args:
        rgb: [H, W, 3] the rendering, float32 or float64; the loss is differentiable in it.
        target: [H, W, 3] the image, same dtype, values in [0, 1].
        l1_weight: λ, 1 − `LossConfig.ssim_lambda`; the field uses 0.8.
        mse_fraction: fraction of MSE; 0 is equation 13, 1 is `MSE_SCALE` times the mean squared error.
        mask: [H, W] bool, true where pixels count; None: all do. The loss is the mean over those, and the rendering's
            others are replaced by the image's, as `filled` does.
    """
    check_pair(rgb, target)
    rest = 1 - mse_fraction
    weights = rest * l1_weight, mse_fraction * MSE_SCALE, rest * (1 - l1_weight)
    apply = _Photometric.apply if arrays.has_kernels(rgb) else TorchPhotometric.apply
    if mask is None:
        return apply(rgb, target, *weights)
    return apply(filled(rgb, target, mask), target, *weights) * share_factor(mask, rgb.dtype)


def ssim(rgb: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the mean structural similarity over the pixels of `mask`, a scalar, differentiable in `rgb`.

    Window 11, σ = 1.5, data range 1, and zeros beyond the border, as the 3D Gaussian projects compute it.
    """
    return 1 - photometric_loss(rgb, target, 0.0, 0.0, mask)


def filled(rgb: Tensor, target: Tensor, mask: Tensor) -> Tensor:
    """The rendering, [H, W, 3], with the image's own pixels outside of `mask`, where it then has neither error nor
    gradient. Windows of SSIM across the mask's border see the image there."""
    return torch.where(mask[..., None], rgb, target)


def share_factor(mask: Tensor, dtype: torch.dtype) -> Tensor:
    """What turns a mean over all pixels, with no error outside of `mask`, into the mean over the pixels of the mask; a
    scalar."""
    return mask.numel() / mask.sum().to(dtype).clamp(min=1)


def check_pair(rgb: Tensor, target: Tensor) -> None:
    """Raise `InvalidInput` unless both are images [H, W, 3] of one shape and dtype."""
    if rgb.ndim != 3 or rgb.shape[-1] != 3 or math.prod(rgb.shape) == 0:
        raise InvalidInput("rgb", "of shape [H, W, 3], not empty", tuple(rgb.shape))
    if target.shape != rgb.shape or target.dtype != rgb.dtype:
        raise InvalidInput(
            "target", f"{rgb.dtype} of shape {tuple(rgb.shape)}", f"{target.dtype} {tuple(target.shape)}"
        )


class _Photometric(torch.autograd.Function):
    """The weighted sum of L1, MSE and 1 − SSIM."""

    @staticmethod
    def forward(ctx: Any, rgb: Tensor, target: Tensor, l1: float, mse: float, dssim: float) -> Tensor:
        x, y = (to_array(image).reshape(len(image), -1) for image in (rgb, target))
        gradient, taps = np.empty_like(x), tuple(TAPS[: RADIUS + 1].astype(x.dtype))
        weights = l1 / x.size, mse / x.size, -dssim / x.size
        sums = loss_sums_and_gradient(x, y, taps, weights, gradient)
        ctx.save_for_backward(torch.from_numpy(gradient).reshape(rgb.shape).to(rgb.device))
        return torch.tensor(sums @ weights + dssim, dtype=rgb.dtype, device=rgb.device)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        return grad * ctx.saved_tensors[0], None, None, None, None

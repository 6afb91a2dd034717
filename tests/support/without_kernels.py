"""Training as on a GPU, without one: torch's operations instead of kernels, and a stand-in for gsplat.

The stand-in draws with the project's own kernels. It has gsplat's arguments, and its `meta`, as `rendering.cuda` uses
them.
"""

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from msdgs_serve.rasterizer import GSPLAT
from msdgs_serve.scene import Camera
from msdgs_train.layers import arrays
from msdgs_train.rendering import cuda
from msdgs_train.rendering.info import RasterizationInfo
from msdgs_train.rendering.rasterize import _Rasterize

READS = {"_local_scalar_dense", "nonzero", "masked_select", "is_nonzero", "equal"}
"""Operations whose results the CPU reads."""


class NoReads(TorchDispatchMode):
    """Refuses operations for which the CPU would wait for a GPU."""

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        name = func.overloadpacket.__name__
        by_mask = name.startswith("index") and any(
            isinstance(each, Tensor) and each.dtype == torch.bool
            for arg in args
            if isinstance(arg, list)
            for each in arg
        )
        if name in READS or by_mask:
            raise AssertionError(f"{func} makes the CPU wait for the device")
        return func(*args, **(kwargs or {}))


class _Draw(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, camera: Camera, options: Any, absolute: bool, background: Tensor, means2d: Tensor, *gaussians: Tensor
    ) -> tuple[Tensor, ...]:
        info, leaves = RasterizationInfo(), [tensor.detach().requires_grad_() for tensor in gaussians]
        with torch.enable_grad():
            images = _Rasterize.apply(camera, options, info, absolute, background, *leaves)
        ctx.kept = info, leaves, images, absolute, means2d
        return *(image.detach() for image in images), info.radii

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> tuple[Tensor | None, ...]:
        info, leaves, images, absolute, means2d = ctx.kept
        found = torch.autograd.grad(images, leaves, grads[:2])
        assert info.means2d_grads is not None
        screen = info.means2d_grads[None]
        if absolute:
            means2d.absgrad, screen = screen, torch.zeros_like(screen)
        return None, None, None, None, screen, *found


def rasterization(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    *,
    near_plane: float,
    eps2d: float,
    sh_degree: int,
    packed: bool,
    absgrad: bool,
    covars: Tensor | None,
    backgrounds: Tensor,
) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
    """One image."""
    assert (packed, covars) == (False, None)
    assert colors.shape[1] == (sh_degree + 1) ** 2
    (fx, _, cx), (_, fy, cy), _ = Ks[0].double().numpy()
    camera = Camera(fx, fy, cx, cy, width, height, np.linalg.inv(viewmats[0].double().numpy()))
    options = GSPLAT._replace(near_plane=near_plane, eps2d=eps2d)
    means2d = (0 * means[:, :2])[None]
    gaussians = (means, quats, scales, opacities, colors)
    rgb, alpha, radii = _Draw.apply(camera, options, absgrad, backgrounds[0], means2d, *gaussians)
    return rgb[None], alpha[None, ..., None], {"radii": radii[None, :, None].expand(-1, -1, 2), "means2d": means2d}


def switch_kernels_off(monkeypatch: pytest.MonkeyPatch) -> None:
    """From now on."""
    monkeypatch.setattr(arrays, "has_kernels", lambda tensor: False)
    monkeypatch.setattr(cuda.gsplat, "rasterization", rasterization)

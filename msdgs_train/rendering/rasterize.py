"""Differentiable rendering: the service's own kernels on a CPU, gsplat on CUDA, behind one function."""

import importlib
import importlib.util
from typing import Any

import numpy as np
import torch
from torch import Tensor

from msdgs_serve.rasterizer.compositing import Frame, composite
from msdgs_serve.rasterizer.compositing_backward import ABSOLUTE, composite_backward
from msdgs_serve.rasterizer.projection import project
from msdgs_serve.rasterizer.projection_backward import project_backward
from msdgs_serve.rasterizer.tiles import bin_into_tiles
from msdgs_serve.rasterizer.view import GSPLAT, RasterizerOptions
from msdgs_serve.scene import Camera, Gaussians
from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.layers import arrays
from msdgs_train.layers.arrays import to_array
from msdgs_train.rendering.info import RasterizationInfo


def require_device(device: str) -> None:
    """Raise `InvalidInput` unless this machine can render on `device`."""
    if device == "cpu":
        return
    if not torch.cuda.is_available():
        raise InvalidInput("device", "cpu, as torch finds no GPU here", device)
    if importlib.util.find_spec("gsplat") is None:
        raise InvalidInput("device", "cpu without gsplat, which renders on a GPU: pip install 'msdgs[cuda]'", device)
    backend = importlib.import_module("gsplat.cuda._backend")  # compiles kernels, for minutes the first time
    if backend._C is None:
        raise InvalidInput("device", "cpu without CUDA's compiler, nvcc, which gsplat needs", device)


def rasterize(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    sh: Tensor,
    camera: Camera,
    background: Tensor,
    options: RasterizerOptions = GSPLAT,
    *,
    absolute_gradients: bool = False,
    raw_quats: bool = False,
) -> tuple[Tensor, Tensor, RasterizationInfo]:
    """Draw N activated Gaussians; differentiable in every tensor.

    Args:
        means: [N, 3] world space.
        quats: [N, 4] wxyz, unit, unless `raw_quats`.
        scales: [N, 3] standard deviations, scene units.
        opacities: [N] in (0, 1).
        sh: [N, (degree + 1)², 3].
        camera: pinhole, OpenCV axes.
        background: [3] color behind everything.
        options: rasterizer constants; on CUDA gsplat's limits of alpha and transmittance are fixed.

    Returns:
        rgb [H, W, 3] with the background, alpha [H, W], and what density control reads of the rendering.
    """
    info = RasterizationInfo()
    gaussians = (means, quats, scales, opacities, sh)
    if not arrays.has_kernels(means):
        from msdgs_train.rendering.cuda import rasterize_cuda

        rgb, alpha = rasterize_cuda(gaussians, camera, background, options, info, absolute_gradients, raw_quats)
    else:
        rgb, alpha = _Rasterize.apply(camera, options, info, absolute_gradients, background, *gaussians)
    return rgb, alpha, info


BACKGROUND = 4
"""Index of `background` among the arguments. Its gradient is only computed on demand: for a large image it takes half
as long as all others."""


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        camera: Camera,
        options: RasterizerOptions,
        info: RasterizationInfo,
        absolute_gradients: bool,
        background: Tensor,
        *gaussians: Tensor,
    ) -> tuple[Tensor, Tensor]:
        splats = project(Gaussians(*map(to_array, gaussians)), camera, options)
        tiles = bin_into_tiles(splats, camera.width, camera.height)
        frame = composite(splats, tiles, camera.width, camera.height, to_array(background), options)
        info.radii = torch.from_numpy(np.maximum(splats.extents[:, 0], splats.extents[:, 1]))
        image = torch.from_numpy(frame.rgb)
        # saved as tensors: autograd then notices if one is written to before the backward pass
        ctx.save_for_backward(*gaussians, image)
        ctx.drawn = (splats, tiles, frame.alpha)
        ctx.view = (camera, options)
        ctx.info, ctx.absolute = info, absolute_gradients
        return image, torch.from_numpy(frame.alpha)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Any) -> tuple[Tensor | None, ...]:
        *arrays, rgb = map(to_array, ctx.saved_tensors)
        splats, tiles, alpha = ctx.drawn
        grad_rgb, grad_alpha = (np.ascontiguousarray(grad.numpy()) for grad in grad_outputs)
        frame = Frame(rgb, alpha, depth=np.empty((0, 0), rgb.dtype))
        sums = composite_backward(splats, tiles, ctx.view[1], frame, grad_rgb, grad_alpha, absolute=ctx.absolute)
        grads = project_backward(Gaussians(*arrays), splats, sums, *ctx.view)
        ctx.info.means2d_grads = torch.from_numpy(sums[:, ABSOLUTE] if ctx.absolute else grads.means2d)
        arrays = (grads.means, grads.quats, grads.scales, grads.opacities, grads.sh)
        grad_background = None
        if ctx.needs_input_grad[BACKGROUND]:
            grad_background = torch.from_numpy(np.einsum("hw,hwc->c", 1 - alpha, grad_rgb))
        return None, None, None, None, grad_background, *(torch.from_numpy(array) for array in arrays)

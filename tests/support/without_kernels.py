"""Training as on a GPU, without one: torch's operations instead of kernels, and a stand-in for gsplat.

The stand-in draws with the project's own kernels. It has gsplat's arguments, and its `meta`, as `rendering.cuda` uses
them.
"""

import sys
import traceback
from typing import Any, Self

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.weak import WeakTensorKeyDictionary

from msdgs_serve.rasterizer import GSPLAT
from msdgs_serve.rasterizer.compositing import Frame
from msdgs_serve.rasterizer.compositing_backward import composite_backward
from msdgs_serve.rasterizer.view import view_of
from msdgs_serve.scene import Camera
from msdgs_serve.scene.quaternion import from_matrix
from msdgs_train.layers import arrays
from msdgs_train.layers.arrays import to_array
from msdgs_train.rendering import cuda
from msdgs_train.rendering.info import RasterizationInfo
from msdgs_train.rendering.rasterize import _Rasterize

READS = {"_local_scalar_dense", "nonzero", "masked_select", "is_nonzero", "equal", "_linalg_svd"}
"""Operations whose results the CPU reads; of a decomposition, whether it has converged."""
TRAINER = "/msdgs_train/"


class NoReads(TorchDispatchMode):
    """Refuses operations for which the CPU would wait for a GPU, but `allowed` ones, with the trainer's files that call
    them. Tensors that a generator drew, and what is computed of them alone, are on the CPU in any case."""

    def __init__(self, *allowed: tuple[str, str]) -> None:
        super().__init__()
        self._allowed, self._copies = allowed, _NoCopies()
        self._on_cpu = WeakTensorKeyDictionary()

    def __enter__(self) -> Self:
        self._copies.__enter__()
        return super().__enter__()

    def __exit__(self, *error: Any) -> None:
        super().__exit__(*error)
        self._copies.__exit__(*error)

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        kwargs = kwargs or {}
        tensors = [each for each in tree_leaves(args) if isinstance(each, Tensor)]
        on_cpu = bool(tensors) and all(each in self._on_cpu for each in tensors)
        name = func.overloadpacket.__name__
        by_mask = name.startswith("index") and any(
            isinstance(each, Tensor) and each.dtype == torch.bool
            for arg in args
            if isinstance(arg, list)
            for each in arg
        )
        if (name in READS or by_mask) and not on_cpu:
            _refuse(name, self._allowed)
        result = func(*args, **kwargs)
        if on_cpu or kwargs.get("generator") is not None:
            for each in tree_leaves(result):
                if isinstance(each, Tensor):
                    self._on_cpu[each] = True
        return result


class _NoCopies(TorchFunctionMode):
    """Refuses copies to a device of what is on the CPU, lists of indices among it; `arrays.to_device` doesn't wait."""

    def __torch_function__(self, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        kwargs, name = kwargs or {}, getattr(func, "__name__", "")
        if name == "to":
            copies = "device" in kwargs or any(isinstance(each, Tensor | torch.device | str) for each in args[1:])
        elif name in ("__getitem__", "__setitem__"):
            index = args[1]
            copies = any(isinstance(each, list) for each in (index if isinstance(index, tuple) else (index,)))
        else:
            copies = name == "new_tensor" or (name in ("tensor", "as_tensor") and kwargs.get("device") is not None)
        if copies and TRAINER in sys._getframe(1).f_code.co_filename:  # torch itself moves nothing
            _refuse(name)
        return func(*args, **kwargs)


def _refuse(name: str, allowed: tuple[tuple[str, str], ...] = ()) -> None:
    """Raise, unless the innermost file of the trainer may call it."""
    files = (frame.filename for frame in reversed(traceback.extract_stack()))
    caller = next((file for file in files if TRAINER in file), "")
    if not any(caller.endswith(file) and name == operation for file, operation in allowed):
        raise AssertionError(f"{name} makes the CPU wait for the device, called by {caller}")


class _Draw(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        camera: Camera,
        options: Any,
        absolute: bool,
        background: Tensor,
        means2d: Tensor,
        covariances: Tensor | None,
        *gaussians: Tensor,
    ) -> tuple[Tensor, ...]:
        if covariances is not None:
            gaussians = (gaussians[0], *_ellipsoids(covariances), *gaussians[3:])
        info, leaves = RasterizationInfo(), [tensor.detach().requires_grad_() for tensor in gaussians]
        with torch.enable_grad():
            images = _Rasterize.apply(camera, options, info, absolute, background, *leaves)
        ctx.kept = info, leaves, images, absolute, means2d, covariances
        return *(image.detach() for image in images), info.radii

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> tuple[Tensor | None, ...]:
        info, leaves, images, absolute, means2d, covariances = ctx.kept
        found, of_covariances = list(torch.autograd.grad(images, leaves, grads[:2], retain_graph=True)), None
        assert info.means2d_grads is not None
        screen = info.means2d_grads[None]
        if absolute:
            means2d.absgrad, screen = screen, torch.zeros_like(screen)
        if covariances is not None:
            of_covariances = _covariance_gradients(images, leaves[0], covariances, grads[:2])
            found[1:3] = None, None
        return None, None, None, None, screen, of_covariances, *found


def _ellipsoids(covariances: Tensor) -> tuple[Tensor, Tensor]:
    """Unit quaternions, [N, 4], and scales, [N, 3]."""
    squares, axes = np.linalg.eigh(to_array(covariances).astype(np.float64))
    axes[:, :, 0] *= np.linalg.det(axes)[:, None]
    quats, scales = from_matrix(axes), np.sqrt(np.maximum(squares, 0))
    return torch.from_numpy(quats).to(covariances.dtype), torch.from_numpy(scales).to(covariances.dtype)


def _covariance_gradients(
    images: tuple[Tensor, Tensor], means: Tensor, covariances: Tensor, grads: tuple[Tensor, Tensor]
) -> Tensor:
    """[N, 3, 3] from the gradients of rgb and alpha: of the conic, which the kernels sum up, and from there by hand."""
    (splats, tiles, alpha), (camera, options) = images[0].grad_fn.drawn, images[0].grad_fn.view  # type: ignore
    frame = Frame(to_array(images[0]), alpha, depth=np.empty((0, 0), alpha.dtype))
    sums = composite_backward(splats, tiles, options, frame, *(np.ascontiguousarray(to_array(g)) for g in grads))
    of_conics = 0.5 * sums[:, [6, 7, 7, 8]].reshape(-1, 2, 2).astype(np.float64)
    view, drawn = view_of(camera, options), splats.extents[:, 0] > 0
    x, y, z = np.array(view.rotation) @ to_array(means).T.astype(np.float64) + np.array(view.translation)[:, None]
    jacobians = np.zeros((len(z), 2, 3))
    jacobians[:, 0, 0], jacobians[:, 1, 1] = view.fx / z, view.fy / z
    jacobians[:, 0, 2] = -view.fx / z * np.clip(x / z, view.min_x, view.max_x)
    jacobians[:, 1, 2] = -view.fy / z * np.clip(y / z, view.min_y, view.max_y)
    maps = (jacobians @ np.array(view.rotation))[drawn]  # of world to image
    shapes = maps @ to_array(covariances)[drawn] @ maps.transpose(0, 2, 1) + options.eps2d * np.eye(2)
    conics, found = np.linalg.inv(shapes), np.zeros(covariances.shape)
    found[drawn] = -maps.transpose(0, 2, 1) @ conics @ of_conics[drawn] @ conics @ maps
    return torch.from_numpy(found).to(covariances.dtype)


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
    """One image; `covars` take the place of quaternions and scales."""
    assert not packed
    assert colors.shape[1] == (sh_degree + 1) ** 2
    (fx, _, cx), (_, fy, cy), _ = Ks[0].double().numpy()
    camera = Camera(fx, fy, cx, cy, width, height, np.linalg.inv(viewmats[0].double().numpy()))
    options = GSPLAT._replace(near_plane=near_plane, eps2d=eps2d)
    means2d = (0 * means[:, :2])[None]
    gaussians = (means, quats, scales, opacities, colors)
    rgb, alpha, radii = _Draw.apply(camera, options, absgrad, backgrounds[0], means2d, covars, *gaussians)
    return rgb[None], alpha[None, ..., None], {"radii": radii[None, :, None].expand(-1, -1, 2), "means2d": means2d}


def switch_kernels_off(monkeypatch: pytest.MonkeyPatch) -> None:
    """From now on."""
    monkeypatch.setattr(arrays, "has_kernels", lambda tensor: False)
    monkeypatch.setattr(cuda.gsplat, "rasterization", rasterization)

"""Rendering by gsplat for CUDA tensors. Its kernels fix the alpha and transmittance limits of `GSPLAT`."""

import gsplat
import torch
from torch import Tensor

from msdgs_serve.rasterizer.view import GSPLAT, RasterizerOptions
from msdgs_serve.scene import Camera, InvalidInput
from msdgs_train.layers.arrays import to_device
from msdgs_train.layers.quaternions import rotation_matrices
from msdgs_train.rendering.info import RasterizationInfo


def rasterize_cuda(
    gaussians: tuple[Tensor, ...],
    camera: Camera,
    background: Tensor,
    options: RasterizerOptions,
    info: RasterizationInfo,
    absolute_gradients: bool,
    raw_quats: bool,
) -> tuple[Tensor, Tensor]:
    """Return rgb [H, W, 3] and alpha [H, W]; arguments as in `rasterize`, float32 on one device."""
    if options._replace(near_plane=GSPLAT.near_plane, eps2d=GSPLAT.eps2d, alpha_max=GSPLAT.alpha_max) != GSPLAT:
        raise InvalidInput("options", "gsplat's least alpha and transmittance on CUDA", options)
    means, quats, scales, opacities, sh = gaussians
    covariances = None
    if raw_quats:  # gsplat would scale them to unit length
        axes = rotation_matrices(quats) * scales[:, None]
        covariances = axes @ axes.transpose(1, 2)
    intrinsics = torch.tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]], dtype=torch.float32)
    rgb, alpha, meta = gsplat.rasterization(
        means,
        quats,
        scales,
        opacities,
        sh,
        to_device(torch.tensor(camera.world_to_camera, dtype=torch.float32), means.device)[None],
        to_device(intrinsics, means.device)[None],
        camera.width,
        camera.height,
        near_plane=options.near_plane,
        eps2d=options.eps2d,
        sh_degree=round(sh.shape[1] ** 0.5) - 1,
        packed=False,
        absgrad=absolute_gradients,
        covars=covariances,
        backgrounds=background[None],
    )
    info.radii = meta["radii"][0].amax(dim=-1).to(means.dtype)
    means2d = meta["means2d"]
    if means2d.requires_grad:  # gsplat has set `absgrad` when the gradient arrives

        def keep(grad: Tensor) -> None:
            kept = means2d.absgrad if absolute_gradients else grad
            info.means2d_grads = kept[0].nan_to_num(0.0, 0.0, 0.0)  # of steps that the optimizer doesn't take

        means2d.register_hook(keep)
    return rgb[0], alpha[0, ..., 0]

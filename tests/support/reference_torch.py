"""A plain torch float64 renderer whose gradients come from autograd and whose projection is gsplat's own reference.

Dense: every Gaussian at every pixel, so for small images only.
"""

from typing import NamedTuple

import torch
from gsplat.cuda._torch_impl import _fully_fused_projection, _quat_scale_to_covar_preci, _spherical_harmonics
from torch import Tensor

from msdgs_serve.rasterizer import GSPLAT, RasterizerOptions
from msdgs_serve.scene import Camera


class Projection(NamedTuple):
    """gsplat's view of N Gaussians in one camera."""

    means2d: Tensor  # [N, 2] pixels
    depths: Tensor  # [N]
    conics: Tensor  # [N, 3] xx, xy, yy of the inverse covariance
    compensations: Tensor  # [N] factors of the opacities by `mip`
    colors: Tensor  # [N, 3] harmonics plus 0.5, not below 0


def project(
    means: Tensor, quats: Tensor, scales: Tensor, sh: Tensor, camera: Camera, options: RasterizerOptions = GSPLAT
) -> Projection:
    """Projection, covariance and color by gsplat's reference functions."""
    covars, _ = _quat_scale_to_covar_preci(quats, scales, compute_preci=False)
    assert covars is not None
    view = torch.from_numpy(camera.world_to_camera).to(means.dtype)[None]
    intrinsics = means.new_tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])[None]
    size = (camera.width, camera.height)
    _, means2d, depths, conics, compensations = _fully_fused_projection(
        means,
        covars,
        view,
        intrinsics,
        *size,
        eps2d=options.eps2d,
        near_plane=options.near_plane,
        calc_compensations=True,
        camera_model="ortho" if camera.model == "orthographic" else camera.model,  # pyright: ignore[reportArgumentType]
    )
    assert compensations is not None
    degree = {1: 0, 4: 1, 9: 2, 16: 3}[sh.shape[1]]
    directions = means - means.new_tensor(camera.position)
    colors = (_spherical_harmonics(degree, directions, sh) + 0.5).clamp(min=0)
    return Projection(means2d[0], depths[0], conics[0], compensations[0], colors)


def render(
    splats: Projection, opacities: Tensor, camera: Camera, background: Tensor, options: RasterizerOptions = GSPLAT
) -> tuple[Tensor, Tensor]:
    """Equation 2: rgb [H, W, 3] and alpha [H, W]."""
    dtype = opacities.dtype
    rows, columns = (torch.arange(count, dtype=dtype) + 0.5 for count in (camera.height, camera.width))
    y, x = torch.meshgrid(rows, columns, indexing="ij")
    rgb = torch.zeros(*x.shape, 3, dtype=dtype)
    transmittance = torch.ones_like(x)
    stopped = torch.zeros_like(x, dtype=torch.bool)
    for k in torch.argsort(splats.depths.detach().float(), stable=True).tolist():
        if splats.depths[k] <= options.near_plane:
            continue
        dx, dy = x - splats.means2d[k, 0], y - splats.means2d[k, 1]
        xx, xy, yy = splats.conics[k]
        sigma = 0.5 * (xx * dx * dx + yy * dy * dy) + xy * dx * dy
        alpha = (opacities[k] * torch.exp(-sigma)).clamp(max=options.alpha_max)
        drawn = (alpha >= options.alpha_min) & ~stopped
        after = transmittance * (1 - alpha)
        stopped = stopped | (drawn & (after <= options.transmittance_min))
        drawn = drawn & ~stopped
        rgb = rgb + torch.where(drawn, alpha * transmittance, 0.0)[..., None] * splats.colors[k]
        transmittance = torch.where(drawn, after, transmittance)
    return rgb + transmittance[..., None] * background, 1 - transmittance

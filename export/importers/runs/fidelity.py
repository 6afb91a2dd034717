"""Properties of a run that a scene file can't hold, and the PSNR that this costs.

The rasterizer of Deformable-3D-Gaussians doesn't normalize quaternions: if the norm isn't 1, the matrix is no rotation
and shears the Gaussian, and the sign of a scale is lost in its square. The result is still an ellipsoid.

Opacities and colors that change with time are replaced by their means, since a scene file stores constants.
"""

from dataclasses import replace

import numpy as np
import torch

from export.importers.runs.base import Loss
from export.importers.splats.base import as_float32, logit
from export.measure.frames import compare, render
from export.measure.poses import in_float64, posed
from export.measure.rendered_error import ExactFrames
from export.measure.views import cameras_of, selection_views
from msdgs_serve.scene.gaussians import Gaussians
from msdgs_serve.scene.quaternion import from_matrix
from msdgs_train.gaussians.canonical import CanonicalGaussians
from msdgs_train.gaussians.model import DynamicGaussians
from msdgs_train.gaussians.model_file import SceneInfo
from msdgs_train.gaussians.scale_space import MIN_SCALE, activated_scales
from msdgs_train.layers.quaternions import unit_or_identity

FRAMES = 12
"""Number of frames that are compared, each of another camera and time."""

TIMES = 41
"""Number of times over which opacities and colors are averaged."""


def quaternion_fidelity(model: DynamicGaussians, info: SceneInfo) -> Loss:
    """The cost of unit quaternions. The model has one layer that adds to scales and to unit quaternions."""
    psnrs, largest = [], 0.0
    for view in selection_views(cameras_of(info), info.time_range, FRAMES):
        ours = posed(model, view.t)
        theirs, deviation = as_trained(model, view.t, ours)
        frames = [render(each, view.camera, info.background, model.rasterizer) for each in (theirs, ours)]
        psnrs.append(compare(*frames).psnr)
        largest = max(largest, deviation)
    note = (
        f"the run's renderer uses quaternions of any norm (largest difference from 1: {largest:.3g}), a scene file "
        f"unit ones: frames are {np.mean(psnrs):.1f} dB from the run's, the worst of {FRAMES} {min(psnrs):.1f} dB"
    )
    what = "lengths of quaternions, which shear shapes, and signs of scales"
    return Loss("quaternion_fidelity", what, len(model.gaussians), min(psnrs), note)


@torch.no_grad()
def as_trained(model: DynamicGaussians, t: float, ours: Gaussians) -> tuple[Gaussians, float]:
    """The Gaussians `ours` as the program that trained them draws them, and the largest difference of a norm from 1."""
    g = model.gaussians
    step = model.deformation.layers[0](g.means, torch.tensor(t, dtype=g.means.dtype))
    quats = (unit_or_identity(g.raw_quats) + step.delta_quats).double()
    scales = (activated_scales(g.log_scales) + step.delta_scales).double()
    axes, lengths, _ = torch.linalg.svd(_unnormalized_matrices(quats) * scales[:, None, :])
    axes[:, :, 2] *= torch.linalg.det(axes).sign()[:, None]
    deviation = float((torch.linalg.vector_norm(quats, dim=1) - 1).abs().max()) if len(quats) else 0.0
    rotated, sizes = from_matrix(axes.numpy()).astype(np.float32), lengths.clamp_min(MIN_SCALE).float().numpy()
    return Gaussians(ours.means, rotated, sizes, ours.opacities, ours.sh), deviation


def _unnormalized_matrices(quats: torch.Tensor) -> torch.Tensor:
    """[N, 3, 3] the formula of the rotation matrix of a unit wxyz quaternion, for quaternions of any norm."""
    w, x, y, z = quats.unbind(1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, dim=1) for row in rows], dim=1)


def static_appearance(model: DynamicGaussians, info: SceneInfo) -> tuple[DynamicGaussians, Loss]:
    """The model without its heads of opacity and SH, with mean opacities, and mean colors weighted by opacity."""
    opacities, sh = _means(model, info.time_range)
    tensors = dict(model.gaussians.named_parameters()) | {
        "raw_opacities": torch.from_numpy(as_float32(logit(opacities.numpy()))),
        "sh_dc": sh[:, :1].float(),
        "sh_rest": sh[:, 1:].float(),
    }
    static = DynamicGaussians(
        replace(model.config, opacity_head=False, sh_head=False),
        CanonicalGaussians(**{name: tensor.detach().clone() for name, tensor in tensors.items()}),
    )
    kept = {name for name in static.state_dict() if not name.startswith("gaussians.")}
    static.load_state_dict({n: v for n, v in model.state_dict().items() if n in kept}, strict=False)
    views = selection_views(cameras_of(info), info.time_range, FRAMES)
    exact = ExactFrames(in_float64(model), len(model.gaussians), views, info.background, model.rasterizer)
    error = exact.measure(lambda t: posed(static, t), np.arange(len(model.gaussians)))
    what = "changes of opacities and colors with time, replaced by their means"
    note = (
        f"opacities and colors that change with time are replaced by their means: frames are {error.psnr_mean:.1f} dB "
        f"from the run's, the worst of {error.frames} {error.psnr_worst:.1f} dB"
    )
    return static, Loss("static_appearance", what, len(model.gaussians), error.psnr_worst, note)


@torch.no_grad()
def _means(model: DynamicGaussians, time_range: tuple[float, float]) -> tuple[torch.Tensor, torch.Tensor]:
    """Means over time of opacities, [N], and of SH coefficients, [N, C, 3]; float64."""
    opacities, sh = torch.zeros(()), torch.zeros(())
    for t in np.linspace(*time_range, TIMES):
        at = model.pose(float(t))
        opacity = at.opacities.double()
        opacities = opacities + opacity / TIMES
        sh = sh + (opacity / TIMES)[:, None, None] * at.sh.double()
    return opacities, sh / opacities.clamp_min(1e-30)[:, None, None]

"""Properties of a run that a scene file can't hold, and the PSNR that this costs.

The rasterizer of Deformable-3D-Gaussians doesn't normalize quaternions: if the norm isn't 1, the matrix is no rotation
and shears the Gaussian. The result is still an ellipsoid.
"""

import numpy as np
import torch

from msdgs_export.importers.runs.base import Loss
from msdgs_export.measure.frames import compare, render
from msdgs_export.measure.poses import posed
from msdgs_export.measure.views import cameras_of, selection_views
from msdgs_serve.scene.gaussians import Gaussians
from msdgs_serve.scene.quaternion import from_matrix, to_matrix
from msdgs_train.gaussians.model import DynamicGaussians
from msdgs_train.gaussians.model_file import SceneInfo
from msdgs_train.gaussians.scale_space import MIN_SCALE, activated_scales
from msdgs_train.layers.quaternions import unit_or_identity

FRAMES = 12
"""Number of frames that are compared, each of another camera and time."""


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
    what = "lengths of quaternions, which shear shapes"
    return Loss("quaternion_fidelity", what, len(model.gaussians), min(psnrs), note)


@torch.no_grad()
def as_trained(model: DynamicGaussians, t: float, ours: Gaussians) -> tuple[Gaussians, float]:
    """The Gaussians `ours` as the program that trained them draws them, and the largest difference of a norm from 1."""
    g = model.gaussians
    step = model.deformation.layers[0](g.means, torch.tensor(t, dtype=g.means.dtype))
    quats = (unit_or_identity(g.raw_quats) + step.delta_quats).double()
    scales = (activated_scales(g.log_scales) + step.delta_scales).double()
    matrices = torch.from_numpy(to_matrix(quats.numpy()))  # by the formula for unit quaternions
    axes, lengths, _ = torch.linalg.svd(matrices * scales[:, None, :])
    axes[:, :, 2] *= torch.linalg.det(axes).sign()[:, None]
    deviation = float((torch.linalg.vector_norm(quats, dim=1) - 1).abs().max()) if len(quats) else 0.0
    rotated, sizes = from_matrix(axes.numpy()).astype(np.float32), lengths.clamp_min(MIN_SCALE).float().numpy()
    return Gaussians(ours.means, rotated, sizes, ours.opacities, ours.sh), deviation

"""Quaternions of any length and scales of any sign, where a scene file holds unit ones and positive ones: the price.

The rasterizer of Deformable-3D-Gaussians writes a quaternion into a rotation matrix as it is. Where its length isn't 1,
the matrix bends shapes; the sign of a scale is squared away. What comes out is an ellipsoid all the same.
"""

from typing import Any, NamedTuple

import numpy as np
import torch

from export.rendered_error import posed, shown
from export.views import cameras_of, deciding_views
from msdgs_serve.scene.gaussians import Gaussians
from msdgs_serve.scene.quaternion import from_matrix
from msdgs_train.evaluation.metrics import psnr_from_mse
from msdgs_train.gaussians.model import SMALLEST_SCALE, DynamicGaussians, activated_scales, unit_quats
from msdgs_train.gaussians.model_file import SceneInfo

FRAMES = 12
"""That are compared, each of another camera and time."""


class Unbent(NamedTuple):
    """How far frames of a model are from those of the program that trained it."""

    psnr_mean: float
    psnr_worst: float
    longest: float  # by which a length differs from 1, at the times compared
    gaussians: int

    def left_out(self) -> dict[str, Any]:
        """As a scene file lists it."""
        n, what = self.gaussians, "lengths of quaternions, which bend shapes, and signs of scales"
        return {"rule": "unbent", "what": what, "count": n, "of": n, "worst_frame_db": self.psnr_worst}

    def note(self) -> str:
        """For whoever imports it."""
        return (
            f"their renderer takes quaternions of any length, here up to {self.longest:.3g} from 1, and a scene file "
            f"unit ones: frames are {self.psnr_mean:.1f} dB from theirs, the worst of {FRAMES} {self.psnr_worst:.1f} dB"
        )


def unbent(model: DynamicGaussians, info: SceneInfo) -> Unbent:
    """Of a model with one layer that adds to scales and to unit quaternions."""
    psnrs, longest = [], 0.0
    for view in deciding_views(cameras_of(info), info.time_range, FRAMES):
        ours = posed(model, view.t)
        theirs, off = bent(model, view.t, ours)
        frames = [shown(each, view.camera, info.background, model.rasterizer) for each in (theirs, ours)]
        psnrs.append(psnr_from_mse(float(np.square(frames[0] - frames[1], dtype=np.float64).mean())))
        longest = max(longest, off)
    return Unbent(float(np.mean(psnrs)), min(psnrs), longest, len(model.gaussians))


@torch.no_grad()
def bent(model: DynamicGaussians, t: float, ours: Gaussians) -> tuple[Gaussians, float]:
    """`ours` as the program that trained them draws them, and by how much a quaternion's length is off 1."""
    g = model.gaussians
    step = model.deformation.layers[0](g.means, torch.tensor(t, dtype=g.means.dtype))
    quats = (unit_quats(g.raw_quats) + step.delta_quats).double()
    scales = (activated_scales(g.log_scales) + step.delta_scales).double()
    axes, lengths, _ = torch.linalg.svd(_as_it_is(quats) * scales[:, None, :])
    axes[:, :, 2] *= torch.linalg.det(axes).sign()[:, None]
    off = float((torch.linalg.vector_norm(quats, dim=1) - 1).abs().max()) if len(quats) else 0.0
    turned, sizes = from_matrix(axes.numpy()).astype(np.float32), lengths.clamp_min(SMALLEST_SCALE).float().numpy()
    return Gaussians(ours.means, turned, sizes, ours.opacities, ours.sh), off


def _as_it_is(quats: torch.Tensor) -> torch.Tensor:
    """[N, 3, 3] the formula of a unit wxyz quaternion's rotation matrix, of quaternions of any length."""
    w, x, y, z = quats.unbind(1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, dim=1) for row in rows], dim=1)

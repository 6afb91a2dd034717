"""What a scene file can't hold of a run, and the PSNR that this costs.

The rasterizer of Deformable-3D-Gaussians doesn't normalise quaternions: if the length isn't 1, the matrix is no
rotation and shears the Gaussian; the sign of a scale is squared away. The result is an ellipsoid all the same.

Opacities and colors that change with time are replaced by their means, since a scene file stores constants.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch

from export.measure.frames import compare, render
from export.measure.poses import posed
from export.measure.rendered_error import ExactFrames, RenderedError
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


class QuaternionFidelity(NamedTuple):
    """Difference between frames with normalised quaternions and those of the program that trained them."""

    psnr_mean: float
    psnr_worst: float
    longest: float  # largest difference of a length from 1, at the times compared
    gaussians: int

    def left_out(self) -> dict[str, Any]:
        """The entry of `left_out` in a scene file."""
        n, what = self.gaussians, "lengths of quaternions, which shear shapes, and signs of scales"
        return {"rule": "quaternion_fidelity", "what": what, "count": n, "of": n, "worst_frame_db": self.psnr_worst}

    def note(self) -> str:
        """One sentence for the user."""
        return (
            f"their renderer takes quaternions of any length, here up to {self.longest:.3g} from 1, and a scene file "
            f"unit ones: frames are {self.psnr_mean:.1f} dB from theirs, the worst of {FRAMES} {self.psnr_worst:.1f} dB"
        )


def quaternion_fidelity(model: DynamicGaussians, info: SceneInfo) -> QuaternionFidelity:
    """Of a model with one layer that adds to scales and to unit quaternions, as Deformable-3D-Gaussians has."""
    psnrs, longest = [], 0.0
    for view in selection_views(cameras_of(info), info.time_range, FRAMES):
        ours = posed(model, view.t)
        theirs, off = as_trained(model, view.t, ours)
        frames = [render(each, view.camera, info.background, model.rasterizer) for each in (theirs, ours)]
        psnrs.append(compare(*frames).psnr)
        longest = max(longest, off)
    return QuaternionFidelity(float(np.mean(psnrs)), min(psnrs), longest, len(model.gaussians))


@torch.no_grad()
def as_trained(model: DynamicGaussians, t: float, ours: Gaussians) -> tuple[Gaussians, float]:
    """`ours` as the program that trained them draws them, and the largest difference of a length from 1."""
    g = model.gaussians
    step = model.deformation.layers[0](g.means, torch.tensor(t, dtype=g.means.dtype))
    quats = (unit_or_identity(g.raw_quats) + step.delta_quats).double()
    scales = (activated_scales(g.log_scales) + step.delta_scales).double()
    axes, lengths, _ = torch.linalg.svd(_as_it_is(quats) * scales[:, None, :])
    axes[:, :, 2] *= torch.linalg.det(axes).sign()[:, None]
    off = float((torch.linalg.vector_norm(quats, dim=1) - 1).abs().max()) if len(quats) else 0.0
    turned, sizes = from_matrix(axes.numpy()).astype(np.float32), lengths.clamp_min(MIN_SCALE).float().numpy()
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


TIMES = 41
"""Number of times that are averaged."""

FRAMES = 12
"""Number of frames that are compared, each of another camera and time."""

NEAREST_TO_END = 1e-7


class StaticAppearance(NamedTuple):
    """A model whose layers change poses only, and the error of its frames against the full model."""

    model: DynamicGaussians
    error: RenderedError

    def left_out(self) -> dict[str, Any]:
        """The entry of `left_out` in a scene file."""
        what = "changes of opacities and colors with time, replaced by their means"
        n = len(self.model.gaussians)
        return {"rule": "static_appearance", "what": what, "count": n, "of": n, "worst_frame_db": self.error.psnr_worst}

    def note(self) -> str:
        """One sentence for the user."""
        e = self.error
        return (
            f"opacities and colors that change with time are replaced by their means: "
            f"frames are {e.psnr_mean:.1f} dB from the run's, the worst of {e.frames} {e.psnr_worst:.1f} dB"
        )


def static_appearance(model: DynamicGaussians, info: SceneInfo) -> StaticAppearance:
    """The model without its heads of opacity and SH, with mean opacities, and mean colors weighted by opacity."""
    opacities, sh = _means(model, info.time_range)
    g = model.gaussians
    opacities = opacities.clamp(NEAREST_TO_END, 1 - NEAREST_TO_END)
    tensors = dict(g.named_parameters()) | {
        "raw_opacities": opacities.logit().float(),
        "sh_dc": sh[:, :1].float(),
        "sh_rest": sh[:, 1:].float(),
    }
    still = DynamicGaussians(
        replace(model.config, opacity_head=False, sh_head=False),
        CanonicalGaussians(**{name: tensor.detach().clone() for name, tensor in tensors.items()}),
    )
    kept = {name for name in still.state_dict() if not name.startswith("gaussians.")}
    still.load_state_dict({n: v for n, v in model.state_dict().items() if n in kept}, strict=False)
    views = selection_views(cameras_of(info), info.time_range, FRAMES)
    exact = ExactFrames(model, views, info.background)
    return StaticAppearance(still, exact.measure(lambda t: posed(still, t), np.arange(len(g))))


@torch.no_grad()
def _means(model: DynamicGaussians, time_range: tuple[float, float]) -> tuple[torch.Tensor, torch.Tensor]:
    """Of opacities, [N], and of SH coefficients, [N, C, 3], over time; float64."""
    opacities, sh = torch.zeros(()), torch.zeros(())
    for t in np.linspace(*time_range, TIMES):
        at = model.pose(float(t))
        opacity = at.opacities.double()
        opacities = opacities + opacity / TIMES
        sh = sh + (opacity / TIMES)[:, None, None] * at.sh.double()
    return opacities, sh / opacities.clamp_min(1e-30)[:, None, None]

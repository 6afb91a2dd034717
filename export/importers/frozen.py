"""Opacities and colours that change with time, where a scene file holds constants: their means, and what that costs."""

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch

from export.rendered_error import ExactFrames, RenderedError, posed
from export.views import cameras_of, deciding_views
from msdgs_train.gaussians.canonical import CanonicalGaussians
from msdgs_train.gaussians.model import DynamicGaussians
from msdgs_train.gaussians.model_file import SceneInfo

TIMES = 41
"""That means are taken over."""

FRAMES = 12
"""That are compared, each of another camera and time."""

NEAREST_TO_END = 1e-7


class Frozen(NamedTuple):
    """A model whose layers change poses only, and how far its frames are from those of the whole."""

    model: DynamicGaussians
    error: RenderedError

    def left_out(self) -> dict[str, Any]:
        """As a scene file lists it."""
        what = "changes of opacities and colours with time, which are held at their means"
        n = len(self.model.gaussians)
        return {"rule": "frozen", "what": what, "count": n, "of": n, "worst_frame_db": self.error.psnr_worst}

    def note(self) -> str:
        """For whoever imports it."""
        e = self.error
        return (
            f"opacities and colours that change with time are held at their means, as a scene file stores them once: "
            f"frames are {e.psnr_mean:.1f} dB from the run's, the worst of {e.frames} {e.psnr_worst:.1f} dB"
        )


def frozen(model: DynamicGaussians, info: SceneInfo) -> Frozen:
    """The model without its heads of opacity and SH, each Gaussian as visible and as bright as it is on average.

    Colours count as much as the Gaussian is visible while it has them.
    """
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
    views = deciding_views(cameras_of(info), info.time_range, FRAMES)
    exact = ExactFrames(model, views, info.background)
    return Frozen(still, exact.measure(lambda t: posed(still, t), np.arange(len(g))))


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

"""Gaussians that are clamped by a limit of the model."""

import numpy as np
import torch

from msdgs_serve.scene.quaternion import MIN_NORM
from msdgs_train.gaussians.model import DynamicGaussians
from msdgs_train.gaussians.modulation import MAX_LOG_FACTOR
from msdgs_train.gaussians.scale_space import LOG_SCALE_LIMIT

NEARLY = 1e-6
"""Relative distance to a limit below which a value counts as being at it."""


@torch.no_grad()
def limits_met(model: DynamicGaussians, scales: list[np.ndarray]) -> dict[str, int]:
    """The number of Gaussians at each limit, without zeros. `scales` are posed ones, [M, 3] per time."""
    g = model.gaussians
    canonical = (g.log_scales.abs() >= LOG_SCALE_LIMIT).any(dim=1)
    found = {
        f"canonical scales at e^±{LOG_SCALE_LIMIT:g}": int(canonical.sum()),
        f"scales at e^±{LOG_SCALE_LIMIT:g}, most at one time": max((_at_limit(s) for s in scales), default=0),
        "quaternions without a direction": int((torch.linalg.vector_norm(g.raw_quats, dim=1) < MIN_NORM).sum()),
    }
    if model.modulation is not None:
        for name, factors in model.modulation(g.embeddings).present().items():
            bounded = (factors.log().abs() >= MAX_LOG_FACTOR * (1 - NEARLY)).any(dim=1)
            found[f"modulation of {name} at e^±{MAX_LOG_FACTOR:g}"] = int(bounded.sum())
    return {what: count for what, count in found.items() if count}


def _at_limit(scales: np.ndarray) -> int:
    with np.errstate(divide="ignore", invalid="ignore"):
        return int((np.abs(np.log(scales)) >= LOG_SCALE_LIMIT * (1 - NEARLY)).any(axis=1).sum())

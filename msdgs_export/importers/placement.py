"""The frame of imported Gaussians: near the origin and of some units, whatever those of their files are."""

from collections.abc import Sequence

import numpy as np

from msdgs_serve.scene.gaussians import Gaussians
from msdgs_serve.scene.similarity import IDENTITY, MAX_SCALE, MIN_SCALE, Similarity

FAR = 100.0
"""Distance of the middle from the origin, in half extents, beyond which float32 loses details."""
KEPT_EXTENTS = (0.1, 1000.0)
"""Half extents, in units of the file, of scenes that keep these: the near plane is at 0.01 units."""
EXTENT = 2.0
"""Half the extent of others, scene units."""
WITHIN = 0.9
"""Fraction of the centers within the extent along each axis: strays are often far away."""


def far_offset(means: np.ndarray) -> np.ndarray | None:
    """[3] a round point in the middle of the centers, [N, 3] float64, if these are far from the origin, else None."""
    middle = np.median(means, axis=0)
    reach = half_side(means - middle)
    if not np.abs(middle).max() > FAR * reach > 0:
        return None
    step = 10.0 ** np.floor(np.log10(reach))
    return np.round(middle / step) * step


def half_side(means: np.ndarray) -> float:
    """Half the largest extent of the centers, [N, 3]."""
    low, high = np.quantile(means, ((1 - WITHIN) / 2, (1 + WITHIN) / 2), axis=0)
    return float((high - low).max()) / 2


def placement(frames: Sequence[Gaussians], offset: np.ndarray | None) -> Similarity:
    """From the frame that a scene of these Gaussians has in a file to that of the imported files, from which their
    centers are `offset` away."""
    extent = max(half_side(frame.means.astype(np.float64)) for frame in frames)
    keeps = extent == 0 or KEPT_EXTENTS[0] <= extent <= KEPT_EXTENTS[1]
    scale = 1.0 if keeps else float(np.clip(float(f"{extent / EXTENT:.3g}"), MIN_SCALE, MAX_SCALE))
    x, y, z = (0.0, 0.0, 0.0) if offset is None else (float(v) for v in offset)
    return Similarity(scale, (x, y, z)) if scale != 1 or offset is not None else IDENTITY

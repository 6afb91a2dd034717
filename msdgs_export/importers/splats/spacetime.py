"""SpacetimeGaussians: Gaussians whose centers are cubic polynomials of time, whose quaternions are linear in it, and
whose opacities rise and fall as a Gaussian in time.

With τ = t − trbf_center, the mean is xyz + motion₀₋₂ τ + motion₃₋₅ τ² + motion₆₋₈ τ³, the quaternion rot + omega τ,
normalized, and the opacity is multiplied by exp(−(τ / exp(trbf_scale))²). Time is in [0, 1].
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from msdgs_export.importers.errors import ImportFailed
from msdgs_export.importers.splats.base import LOG_SCALE_LIMIT
from msdgs_export.importers.splats.ply_columns import Columns

COLUMNS = {"motion": slice(0, 9), "omega": slice(9, 13), "center": slice(13, 14), "log_width": slice(14, 15)}
"""Of the array `Splats.motion`."""

CENTER, WIDTH = "trbf_center", "trbf_scale"
FARTHEST = 100.0
"""From the scene's times, 0 to 1, to a Gaussian's; polynomials grow without end."""


class Spacetime(NamedTuple):
    """The columns by name."""

    motion: np.ndarray  # [N, 9] of τ, τ² and τ³
    omega: np.ndarray  # [N, 4] per unit of time, of unit quaternions
    center: np.ndarray  # [N, 1]
    log_width: np.ndarray  # [N, 1]

    @classmethod
    def of(cls, columns: np.ndarray) -> "Spacetime":
        """From the array of `Splats`."""
        return cls(*(columns[:, part] for part in COLUMNS.values()))


def is_spacetime(columns: Columns) -> bool:
    """Whether any property of motion is there."""
    return any(name.startswith(("motion_", "omega_", "trbf_")) for name in columns.names)


def motion_of(file: Path, columns: Columns, raw_quats: np.ndarray) -> np.ndarray:
    """[N, 15] the properties of motion; those of a motion of lower degree, or without rotation, are 0.

    Raises `ImportFailed` naming what is missing.
    """
    degrees, turns = columns.count("motion_"), columns.count("omega_")
    if missing := [name for name in (CENTER, WIDTH) if not columns.has(name)]:
        raise ImportFailed(file, f"has `motion_…` or `omega_…` of SpacetimeGaussians, but no `{missing[0]}`")
    if degrees not in (0, 3, 6, 9) or turns not in (0, 4):
        problem = f"has {degrees} of `motion_…` and {turns} of `omega_…`"
        raise ImportFailed(file, f"{problem}; SpacetimeGaussians has 9, polynomials of lower degree 3 or 6, and 4")
    found = np.zeros((columns.rows, 15))
    for name, count in (("motion", degrees), ("omega", turns)):
        if count:
            found[:, COLUMNS[name]][:, :count] = columns.stack(f"{name}_", count)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):  # such rows are dropped
        found[:, COLUMNS["omega"]] /= np.linalg.norm(raw_quats, axis=1, keepdims=True)
    center = columns.read(CENTER)[:, None]
    found[:, COLUMNS["center"]] = np.where(np.abs(center) <= FARTHEST, center, np.nan)
    found[:, COLUMNS["log_width"]] = columns.read(WIDTH).clip(-LOG_SCALE_LIMIT, LOG_SCALE_LIMIT)[:, None]
    return found

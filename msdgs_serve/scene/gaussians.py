"""A set of posed 3D Gaussians with activated parameters, the input of the rasterizer."""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.scene.spherical_harmonics import SH_DEGREES, sh_coefficients

FloatArray = npt.NDArray[np.floating]

_PART = 1 << 16
"""Values that are checked at a time, so that checks take no memory."""


@dataclass(frozen=True)
class Gaussians:
    """N Gaussians in world space. Arrays share one dtype: float32, or float64 in tests."""

    means: FloatArray  # [N, 3] centers, scene units
    quats: FloatArray  # [N, 4] rotations, wxyz, unit
    scales: FloatArray  # [N, 3] standard deviations, scene units, > 0
    opacities: FloatArray  # [N] in [0, 1]
    sh: FloatArray  # [N, (degree + 1)², 3] INRIA order; color = SH + 0.5, clamped at 0

    def __len__(self) -> int:
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        return SH_DEGREES[self.sh.shape[1]]

    def scaled(self, factor: float) -> "Gaussians":
        """Return the Gaussians in units that are `factor` times as many per length."""
        return self if factor == 1.0 else replace(self, means=self.means * factor, scales=self.scales * factor)

    def validate_shapes(self) -> None:
        """Raise `InvalidInput` naming the array if shapes are inconsistent; values are not checked."""
        n = len(self.means)
        expected_shapes = {"means": (n, 3), "quats": (n, 4), "scales": (n, 3), "opacities": (n,)}
        for name, shape in expected_shapes.items():
            if getattr(self, name).shape != shape:
                raise InvalidInput(f"gaussians.{name}", f"of shape {shape}", getattr(self, name).shape)
        if self.sh.ndim != 3 or self.sh.shape[0] != n or self.sh.shape[1] not in SH_DEGREES or self.sh.shape[2] != 3:
            counts = [sh_coefficients(d) for d in range(4)]
            raise InvalidInput("gaussians.sh", f"of shape ({n}, one of {counts}, 3)", self.sh.shape)

    def validate(self) -> "Gaussians":
        """Return self, or raise `InvalidInput` naming the array if shapes or values are invalid."""
        self.validate_shapes()
        n = len(self.means)
        for name in ("means", "quats", "scales", "opacities", "sh"):
            bad = count_non_finite(getattr(self, name))
            if bad:
                raise InvalidInput(f"gaussians.{name}", "finite", f"{bad} values that are NaN or infinite")
        if n and not (self.scales > 0).all():
            raise InvalidInput("gaussians.scales", "above 0", float(self.scales.min()))
        if n and not ((self.opacities >= 0) & (self.opacities <= 1)).all():
            raise InvalidInput("gaussians.opacities", "in [0, 1]", f"[{self.opacities.min()}, {self.opacities.max()}]")
        with np.errstate(over="ignore"):
            norms = np.linalg.norm(self.quats, axis=1)
        if n and not (np.abs(norms - 1) < 1e-3).all():
            raise InvalidInput("gaussians.quats", "unit quaternions", f"norms in [{norms.min()}, {norms.max()}]")
        return self


def count_non_finite(array: FloatArray) -> int:
    """Return how many values are NaN or infinite."""
    flat = array.reshape(-1)
    parts = (flat[start : start + _PART] for start in range(0, flat.size, _PART))
    return sum(int(np.count_nonzero(~np.isfinite(part))) for part in parts)

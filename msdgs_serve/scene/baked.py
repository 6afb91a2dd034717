"""The arrays of a scene file (contract `msdgs/1`) that don't depend on time, and their checks."""

from dataclasses import dataclass

import numpy as np

from msdgs_serve.scene.errors import InvalidInput, SceneFileInvalid
from msdgs_serve.scene.gaussians import FloatArray, Gaussians
from msdgs_serve.scene.metadata import CONTRACT, SceneCamera, SceneMetadata
from msdgs_serve.scene.spherical_harmonics import sh_coefficients

__all__ = [
    "CONSTANT_OUTPUTS",
    "CONTRACT",
    "MOVING_OUTPUTS",
    "OPTIONAL_INPUT",
    "BakedScene",
    "SceneCamera",
    "SceneMetadata",
]

OPTIONAL_INPUT = "steps"
MOVING_OUTPUTS = ("means", "quats", "scales")
MAX_SH = 1e30
"""Limit of SH coefficients, within which sums and blends of colors stay finite in float32."""
CONSTANT_OUTPUTS = ("static_means", "static_quats", "static_scales", "opacities", "sh")


@dataclass(frozen=True)
class BakedScene:
    """A scene without its graph. Moving Gaussians come first in `opacities` and `sh`, static ones after them."""

    metadata: SceneMetadata
    moving_count: int
    static_means: FloatArray  # [S, 3]
    static_quats: FloatArray  # [S, 4] wxyz, unit
    static_scales: FloatArray  # [S, 3]
    opacities: FloatArray  # [moving + S]
    sh: FloatArray  # [moving + S, (degree + 1)², 3]

    @property
    def static_count(self) -> int:
        return len(self.static_means)

    def __len__(self) -> int:
        return self.moving_count + self.static_count

    def validate(self, file: str) -> "BakedScene":
        """Return self, or raise `SceneFileInvalid` if shapes or values are invalid. `file` is its name in messages."""
        n, s = len(self), self.static_count
        coefficients = sh_coefficients(self.metadata.sh_degree)
        shapes = {
            "static_means": (s, 3),
            "static_quats": (s, 4),
            "static_scales": (s, 3),
            "opacities": (n,),
            "sh": (n, coefficients, 3),
        }
        for name, shape in shapes.items():
            array = getattr(self, name)
            if array.shape != shape:
                counts = f"{self.moving_count} moving and {s} static Gaussians"
                raise SceneFileInvalid(file, name, f"has shape {array.shape}; {counts} need {shape}")
            if array.dtype != np.float32:
                raise SceneFileInvalid(file, name, f"holds {array.dtype}, not float32")
        if max(self.sh.max(initial=0), -self.sh.min(initial=0)) > MAX_SH:
            raise SceneFileInvalid(file, "sh", f"holds values beyond ±{MAX_SH:g}, whose colors overflow")
        try:
            m = self.moving_count
            Gaussians(
                self.static_means, self.static_quats, self.static_scales, self.opacities[m:], self.sh[m:]
            ).validate()
            filler = np.ones((m, 4), np.float32) / 2
            Gaussians(filler[:, :3], filler, filler[:, :3], self.opacities[:m], self.sh[:m]).validate()
        except InvalidInput as error:
            name = error.field.removeprefix("gaussians.")
            name = name if name in shapes else f"static_{name}"
            raise SceneFileInvalid(file, name, f"can't be used: {error}") from error
        return self

    def gaussians(self, means: FloatArray, quats: FloatArray, scales: FloatArray) -> Gaussians:
        """Return all Gaussians at one time, from the posed moving ones."""
        if not self.moving_count:
            return Gaussians(self.static_means, self.static_quats, self.static_scales, self.opacities, self.sh)
        if self.static_count:
            means = np.concatenate([means, self.static_means])
            quats = np.concatenate([quats, self.static_quats])
            scales = np.concatenate([scales, self.static_scales])
        return Gaussians(means, quats, scales, self.opacities, self.sh)

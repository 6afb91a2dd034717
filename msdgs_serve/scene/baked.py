"""The arrays of a scene file that don't depend on time, and their checks."""

from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from msdgs_serve.scene.errors import InvalidInput, SceneFileInvalid
from msdgs_serve.scene.gaussians import FloatArray, Gaussians
from msdgs_serve.scene.metadata import CONTRACT, SceneCamera, SceneMetadata
from msdgs_serve.scene.spherical_harmonics import sh_coefficients
from msdgs_serve.scene.static_bounds import StaticBounds, static_bounds

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
CONSTANT_OUTPUTS = ("static_means", "static_quats", "static_scales", "opacities", "sh")
MAX_SH = 1e30
"""Limit of SH coefficients, within which sums and blends of colors stay finite in float32."""
APPEARANCE = {"opacities": (0.0, 1.0), "sh": (-MAX_SH, MAX_SH)}
"""Outputs that may depend on time in `msdgs/2`, and the range of their values."""


def constant_outputs(changing: Collection[str]) -> tuple[str, ...]:
    """Names of the outputs with the arrays of `CONSTANT_OUTPUTS`: of those `changing`, the static Gaussians' values."""
    return tuple(f"static_{name}" if name in changing else name for name in CONSTANT_OUTPUTS)


def appearance_problem(name: str, values: FloatArray) -> str | None:
    """What is wrong with opacities or SH; None if nothing is."""
    low, high = APPEARANCE[name]
    if not values.size or (values.min() >= low and values.max() <= high):
        return None
    return f"holds NaN or values outside [{low:g}, {high:g}]"


@dataclass(frozen=True)
class BakedScene:
    """A scene without its graph. Moving Gaussians come first in `opacities` and `sh`, static ones after them; if they
    are `changing`, static ones alone."""

    metadata: SceneMetadata
    moving_count: int
    static_means: FloatArray  # [S, 3]
    static_quats: FloatArray  # [S, 4] wxyz, unit
    static_scales: FloatArray  # [S, 3]
    opacities: FloatArray  # [moving + S], or [S]
    sh: FloatArray  # [moving + S, (degree + 1)², 3], or [S, …]
    changing: tuple[str, ...] = ()  # those of `APPEARANCE` that depend on time

    @property
    def static_count(self) -> int:
        return len(self.static_means)

    @property
    def changes(self) -> bool:
        """Whether frames depend on time."""
        first, last = self.metadata.time_range
        return self.moving_count > 0 and first < last

    @property
    def has_motion(self) -> bool:
        """Whether Gaussians move from one time to the next."""
        return self.changes and not self.metadata.is_switched

    @property
    def posed_outputs(self) -> tuple[str, ...]:
        """What depends on time, in the order of `DeformationSession.pose`."""
        return (*MOVING_OUTPUTS, *self.changing)

    @property
    def static(self) -> tuple[FloatArray, ...]:
        """The static Gaussians' values of `posed_outputs`."""
        appearance = (getattr(self, name) for name in self.changing)
        return (self.static_means, self.static_quats, self.static_scales, *appearance)

    @cached_property
    def static_bounds(self) -> StaticBounds:
        """Bounds of the static Gaussians, for `rasterize`."""
        return static_bounds(self.moving_count, self.static_means, self.static_scales)

    def __len__(self) -> int:
        return self.moving_count + self.static_count

    def validate(self, file: str) -> "BakedScene":
        """Return self, or raise `SceneFileInvalid` if shapes or values are invalid. `file` is its name in messages."""
        n, s = len(self), self.static_count
        rows = {name: s if name in self.changing else n for name in APPEARANCE}
        coefficients = sh_coefficients(self.metadata.sh_degree)
        shapes = {
            "static_means": (s, 3),
            "static_quats": (s, 4),
            "static_scales": (s, 3),
            "opacities": (rows["opacities"],),
            "sh": (rows["sh"], coefficients, 3),
        }
        for (name, shape), output in zip(shapes.items(), constant_outputs(self.changing), strict=True):
            array = getattr(self, name)
            if array.shape != shape:
                counts = f"{self.moving_count} moving and {s} static Gaussians"
                raise SceneFileInvalid(file, output, f"has shape {array.shape}; {counts} need {shape}")
            if array.dtype != np.float32:
                raise SceneFileInvalid(file, output, f"holds {array.dtype}, not float32")
            if name in APPEARANCE and (problem := appearance_problem(name, array)):
                raise SceneFileInvalid(file, output, problem)
        try:
            of_static = (self.opacities[rows["opacities"] - s :], self.sh[rows["sh"] - s :])
            Gaussians(self.static_means, self.static_quats, self.static_scales, *of_static).validate()
        except InvalidInput as error:
            name = error.field.removeprefix("gaussians.")
            raise SceneFileInvalid(file, f"static_{name}", f"can't be used: {error}") from error
        return self

    def gaussians(self, *posed: FloatArray) -> Gaussians:
        """Return all Gaussians at one time, from the `posed_outputs` of the moving ones."""
        if not self.moving_count:
            posed = self.static
        elif self.static_count:
            posed = tuple(np.concatenate(pair) for pair in zip(posed, self.static, strict=True))
        arrays = {"opacities": self.opacities, "sh": self.sh} | dict(zip(self.posed_outputs, posed, strict=True))
        return Gaussians(**arrays)

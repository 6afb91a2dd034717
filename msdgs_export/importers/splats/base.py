"""The result of all readers of splat files: activated Gaussians without those that can't be drawn."""

from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np

from msdgs_export.importers.errors import ImportFailed
from msdgs_export.importers.placement import far_offset
from msdgs_serve.scene.gaussians import FloatArray, Gaussians
from msdgs_serve.scene.quaternion import MIN_NORM

LOG_SCALE_LIMIT = 20.0
"""Scales are clamped to e^-20 and e^20, as in trained models."""

MAX_DISTANCE = 1e12
"""Largest coordinate, scene units. Differences of float32 positions are meaningless beyond."""

MAX_SH = 1e4
"""Largest SH coefficient; usual ones are below 10."""


MIN_LOGIT_DISTANCE = 1e-7
"""Distance of opacities from 0 and 1, which have no finite logit. No pixel of 8 bits differs by it."""


@dataclass(frozen=True)
class Splats:
    """The Gaussians of one file, float32, in its own order and axes."""

    gaussians: Gaussians
    dropped: int = 0  # had NaN, infinity or a quaternion without direction, and are not in `gaussians`
    antialiasing: str = "dilate"  # or "mip", if the file says so
    quat_lengths: FloatArray | None = None  # [N] of the stored quaternions; None: all 1
    warnings: tuple[str, ...] = ()  # what a user should know about the file, each one sentence
    up: np.ndarray | None = None  # [3] unit, if the file says so
    offset: np.ndarray | None = None  # [3] float64, of the Gaussians' origin in the file, if they are far from its own
    motion: FloatArray | None = None  # [N, 15] if its Gaussians move by themselves: `spacetime.COLUMNS`

    def __len__(self) -> int:
        return len(self.gaussians)

    def around(self, origin: np.ndarray) -> Gaussians:
        """The Gaussians with centers relative to a point of the file's world, [3]."""
        moved = (np.zeros(3) if self.offset is None else self.offset) - origin
        g = self.gaussians
        return replace(g, means=as_float32(g.means + moved)) if moved.any() else g

    def to_arrays(self) -> dict[str, np.ndarray]:
        """The fields by name, for `from_arrays`."""
        own = {name: np.array(value) for name, value in vars(self).items() if name != "gaussians" and value is not None}
        return {**vars(self.gaussians), **own}

    @staticmethod
    def from_arrays(arrays: dict[str, np.ndarray]) -> "Splats":
        """The splats of `to_arrays`, read in another process. Raises `InvalidInput` for invalid arrays."""
        names = [field.name for field in fields(Gaussians)]
        gaussians = Gaussians(*(arrays[name] for name in names)).validate()
        warnings = tuple(str(each) for each in arrays["warnings"])
        own = {name: arrays.get(name) for name in ("quat_lengths", "up", "offset", "motion")}
        return Splats(gaussians, int(arrays["dropped"]), str(arrays["antialiasing"]), warnings=warnings, **own)


def splats(
    file: Path,
    means: np.ndarray,
    log_scales: np.ndarray,
    raw_quats: np.ndarray,
    opacities: np.ndarray,
    sh: np.ndarray,
    antialiasing: str = "dilate",
    motion: np.ndarray | None = None,
) -> Splats:
    """Activate stored Gaussians: means [N, 3], log_scales [N, 3], raw_quats [N, 4] wxyz of any norm, opacities [N] in
    [0, 1] and sh [N, C, 3]; `motion`, [N, 15], is kept as it is.

    Rows with NaN, infinity, values beyond the limits above or a quaternion of norm under 1e-8 are dropped and counted;
    log-scales are clamped to ±20. Means far from the origin are moved to it: `Splats.offset`. Raises `ImportFailed` if
    no row is left.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        norms = np.linalg.norm(raw_quats.astype(np.float64), axis=1)
        good = (
            (np.abs(means) <= MAX_DISTANCE).all(axis=1)
            & ~np.isnan(log_scales).any(axis=1)
            & (norms >= MIN_NORM)
            & np.isfinite(norms)
            & ~np.isnan(opacities)
            & (np.abs(sh) <= MAX_SH).all(axis=(1, 2))
        )
        if motion is not None:
            good &= (np.abs(motion) <= MAX_DISTANCE).all(axis=1)
    count = int(good.sum())
    if not count:
        problem = "holds no Gaussians" if not len(good) else f"none of its {len(good):,} Gaussians can be drawn"
        raise ImportFailed(file, problem)
    rows = slice(None) if count == len(good) else good
    centers = means[rows].astype(np.float64)
    offset = far_offset(centers)
    scales = np.exp(log_scales[rows].astype(np.float64).clip(-LOG_SCALE_LIMIT, LOG_SCALE_LIMIT))
    gaussians = Gaussians(
        as_float32(centers if offset is None else centers - offset),
        as_float32(raw_quats[rows] / norms[rows, None]),
        as_float32(scales),
        as_float32(opacities[rows].clip(0, 1)),
        as_float32(sh[rows]),
    )
    moving = None if motion is None else as_float32(motion[rows])
    lengths = as_float32(norms[rows])
    return Splats(gaussians.validate(), len(good) - count, antialiasing, lengths, offset=offset, motion=moving)


def sigmoid(raw_opacities: np.ndarray) -> np.ndarray:
    """Opacities of logits, in float64. Infinite logits, which some converters write, give 0 and 1."""
    x = raw_opacities.astype(np.float64)
    small = np.exp(-np.abs(x))
    return np.where(x >= 0, 1 / (1 + small), small / (1 + small))


def logit(opacities: np.ndarray) -> np.ndarray:
    """Finite logits of opacities, in float64."""
    x = opacities.astype(np.float64).clip(MIN_LOGIT_DISTANCE, 1 - MIN_LOGIT_DISTANCE)
    return np.log(x / (1 - x))


def smallest_three(values: np.ndarray, largest: np.ndarray) -> np.ndarray:
    """[N, 4] quaternions from all components but the largest, [N, 3] in order, and its index, [N] in 0 to 3.

    The largest is positive and such that the norm is 1.
    """
    quats = np.zeros((len(values), 4))
    missing = np.sqrt(np.maximum(0, 1 - np.square(values).sum(axis=1)))
    for place in range(4):
        rows = largest == place
        quats[np.ix_(rows, [i for i in range(4) if i != place])] = values[rows]
        quats[rows, place] = missing[rows]
    return quats


def as_float32(array: np.ndarray) -> FloatArray:
    """The array in float32, contiguous."""
    return np.ascontiguousarray(array, dtype=np.float32)

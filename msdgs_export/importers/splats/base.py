"""The result of all readers of splat files: activated Gaussians without those that can't be drawn."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import NamedTuple

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

UNUSABLE = "NaN, infinity, a quaternion without direction, an SH coefficient above 10⁴ or a center beyond 10¹²"
"""For any of these a Gaussian is left out."""


MIN_LOGIT_DISTANCE = 1e-7
"""Distance of opacities from 0 and 1, which have no finite logit. No pixel of 8 bits differs by it."""

ROWS = 1 << 14
"""Gaussians that are activated at a time: their float64 arrays stay in the processor's caches."""


@dataclass(frozen=True)
class Splats:
    """The Gaussians of one file, float32, in its own order and axes."""

    gaussians: Gaussians
    dropped: int = 0  # had `UNUSABLE` values, and are not in `gaussians`
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


class Stored(NamedTuple):
    """Gaussians as files store them; any dtype."""

    means: np.ndarray  # [N, 3]
    log_scales: np.ndarray  # [N, 3]
    raw_quats: np.ndarray  # [N, 4] wxyz of any norm
    opacities: np.ndarray  # [N] in [0, 1]
    sh: np.ndarray  # [N, C, 3]
    motion: np.ndarray | None = None  # [N, 15], kept as it is


def parts_of(count: int) -> Iterator[slice]:
    """So many rows in parts of `ROWS`, at least one part."""
    for start in range(0, max(count, 1), ROWS):
        yield slice(start, min(start + ROWS, count))


def splats(
    file: Path, count: int, parts: Iterable[Stored], antialiasing: str = "dilate", warnings: tuple[str, ...] = ()
) -> Splats:
    """Activate `count` stored Gaussians, part by part: float64 arrays of all together would take most of the memory.

    Rows with NaN, infinity, values beyond the limits above or a quaternion of norm under 1e-8 are dropped and counted;
    log-scales are clamped to ±20. Means far from the origin are moved to it: `Splats.offset`. Raises `ImportFailed` if
    no row is left.
    """
    kept, arrays = 0, dict[str, np.ndarray]()
    for part in parts:
        rows = _activated(part)
        for name, values in rows.items():
            if name not in arrays:
                arrays[name] = np.empty((count, *values.shape[1:]), values.dtype)
            arrays[name][kept : kept + len(values)] = values
        kept += len(rows["means"])
    if not kept:
        problem = "holds no Gaussians" if not count else f"none of its {count:,} Gaussians can be drawn"
        raise ImportFailed(file, problem)
    arrays = {name: values[:kept] for name, values in arrays.items()}
    means, lengths, moving = arrays.pop("means"), arrays.pop("quat_lengths"), arrays.pop("motion", None)
    offset = far_offset(means)
    gaussians = Gaussians(as_float32(means if offset is None else means - offset), **arrays).validate()
    return Splats(gaussians, count - kept, antialiasing, lengths, warnings, offset=offset, motion=moving)


def _activated(stored: Stored) -> dict[str, np.ndarray]:
    """The rows that can be drawn: means in float64, everything else as in `Splats`."""
    with np.errstate(over="ignore", invalid="ignore"):
        norms = np.linalg.norm(stored.raw_quats.astype(np.float64), axis=1)
        good = (
            (np.abs(stored.means) <= MAX_DISTANCE).all(axis=1)
            & ~np.isnan(stored.log_scales).any(axis=1)
            & (norms >= MIN_NORM)
            & np.isfinite(norms)
            & ~np.isnan(stored.opacities)
            & (np.abs(stored.sh) <= MAX_SH).all(axis=(1, 2))
        )
        if stored.motion is not None:
            good &= (np.abs(stored.motion) <= MAX_DISTANCE).all(axis=1)
    rows = slice(None) if good.all() else good
    log_scales = stored.log_scales[rows].astype(np.float64)
    found = {
        "means": stored.means[rows].astype(np.float64),
        "quats": as_float32(stored.raw_quats[rows] / norms[rows, None]),
        "scales": as_float32(np.exp(log_scales.clip(-LOG_SCALE_LIMIT, LOG_SCALE_LIMIT))),
        "opacities": as_float32(stored.opacities[rows].clip(0, 1)),
        "sh": as_float32(stored.sh[rows]),
        "quat_lengths": as_float32(norms[rows]),
    }
    return found if stored.motion is None else {**found, "motion": as_float32(stored.motion[rows])}


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

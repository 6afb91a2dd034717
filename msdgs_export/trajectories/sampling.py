"""Poses of the moving Gaussians, sampled over time as densely as each of them needs.

All Gaussians are sampled at 65 times. Where errors of cubics between the samples are visible in frames, Gaussians are
sampled again twice as densely, and so on up to 2,049 times, so that only fast and visible motion costs more. Cubics are
compared at every second sample and at a few irregular times (probes), which detect motion with the period of the
samples.
"""

import copy
import hashlib
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from msdgs_export.bake import Baked
from msdgs_export.measure.views import cameras_of_file
from msdgs_export.progress import Track, no_progress
from msdgs_export.target import squared
from msdgs_export.trajectories.poses import POSE, QUATS, ExactPoses
from msdgs_export.trajectories.sensitivity import PASSES, sensitivities, square_roots
from msdgs_serve.scene.camera import Camera

COARSE, FINEST = 64, 2048
"""Numbers of intervals between samples: of all Gaussians, and of the fastest."""

RESOLVED = squared(60)
"""Default of the squared error of a frame that cubics of all Gaussians together, each at its worst time, should not
exceed."""

VISIBLE = 10.0
"""Motion is too fast for the finest samples if cubics add so many times that error."""

PROBES = 9

WORK = 1.5e13
"""Largest number of operations for samples beyond the coarse ones: some minutes of two cores."""

MEMORY = 2 * 2**30
"""Largest size in bytes of samples beyond the coarse ones; Gaussians with the largest errors come first."""

Samples = npt.NDArray[np.floating]  # [M, T, 10] means, linear scales, unit quaternions of one sign along time
Ids = npt.NDArray[np.int64]
Sampler = Callable[[float, Ids], npt.NDArray[np.floating]]  # [M, 10] poses of some Gaussians at a time
Made = TypeVar("Made")


class Trajectories:
    """Samples of one baked scene, used by all plans that are fitted to them."""

    def __init__(
        self,
        baked: Baked,
        track: Track = no_progress,
        cameras: Sequence[Camera] = (),
        resolved: float = RESOLVED,
        sampler: Sampler | None = None,
    ) -> None:
        """`cameras` show how visible errors are; by default those of the scene. Poses are computed in float64 if no
        `sampler` is given."""
        exact = ExactPoses(baked)
        self.count, self._operations, self._sampler = exact.count, exact.operations, sampler or exact.at
        self.time_range = t0, t1 = baked.scene.metadata.time_range
        self.rows = np.arange(self.count)
        """[M] indices of these Gaussians among those that were sampled, whose arrays follow."""
        self.track = track
        self._on_time = track(f"{self.count:,} trajectories", COARSE + 1 + PROBES)
        self._probe_parts = np.arange(1, PROBES + 1) * (np.sqrt(5) - 1) / 2 % 1
        self._probes = self._sampled(self.rows, t0 + (t1 - t0) * self._probe_parts)
        samples = self._sampled(self.rows, np.linspace(t0, t1, COARSE + 1))
        give_one_sign(samples)
        self._levels = {COARSE: (self.rows, samples)}
        self._depth = np.full(self.count, COARSE)  # intervals at which each is sampled
        self.scene, self._resolved = baked.scene, resolved
        cameras = cameras or [camera for _, camera in cameras_of_file(baked.scene.metadata)]
        self.forms = sensitivities(baked.scene, samples, cameras, track("visibility of errors", PASSES))
        """[M, 10, 10] W of all that are sampled: an error e of a pose adds eᵀ W e to the squared error of a frame."""
        self.roots = square_roots(self.forms)
        """[M, 10, 10] A with A Aᵀ = W."""
        self._whole: Trajectories | None = None  # of which these are a part
        self._made: dict[Callable[[Trajectories], Any], Any] = {}
        self._misses = np.zeros(self.count)  # what cubics at the finest level add to the squared error of a frame
        self._refine()

    def some(self, rows: Ids) -> "Trajectories":
        """Trajectories of some of the Gaussians; the samples are shared."""
        made = copy.copy(self)
        made.count, made.rows, made._whole = len(rows), self.rows[rows], self._whole or self
        return made

    @property
    def unresolved(self) -> Ids:
        """Gaussians that move faster than their finest sampling resolves."""
        return np.flatnonzero(np.isin(self.rows, self._missing(VISIBLE * self._resolved)))

    def intervals(self, ids: Ids) -> npt.NDArray[np.int64]:
        """[M] numbers of intervals between the samples of each."""
        return self._depth[self.rows[ids]]

    def on_grid(self, times: int, ids: Ids) -> Samples:
        """[M, T, 10] poses at T = 2ⁿ + 1 evenly spread times, interpolated by cubics between samples."""
        ids = self.rows[ids]
        got = np.empty((len(ids), times, POSE), np.float32)
        for level in np.unique(self._depth[ids]):
            rows = np.flatnonzero(self._depth[ids] == level)
            known, stored = self._levels[level]
            values = stored[np.searchsorted(known, ids[rows])]
            while values.shape[1] < times:
                values = _with_between(values, _cubic_between(values))
            got[rows] = values[:, :: (values.shape[1] - 1) // (times - 1)]
        return got

    def once(self, make: "Callable[[Trajectories], Made]") -> Made:
        """What `make` returns for all Gaussians that were sampled; made once, whichever part of them asks."""
        if make not in self._made:
            self._made[make] = make(self._whole or self)
        return self._made[make]

    def _missing(self, allowed: float) -> Ids:
        """Those with the largest errors: the errors of all others add up to no more than `allowed`."""
        order = np.argsort(self._misses)
        return order[np.cumsum(self._misses[order]) > allowed]

    def _refine(self) -> None:
        ids, samples = self._levels[COARSE]
        self._misses[:] = self._missed(ids, samples)
        level, memory, work = COARSE, MEMORY, WORK
        while level < FINEST:
            level *= 2
            fast = self._missing(self._resolved)
            fast = fast[self._depth[fast] == level // 2]
            most = min(memory / ((level + 1) * POSE * 4), work / (level // 2 * self._operations))
            fast = np.sort(fast[np.argsort(-self._misses[fast])[: int(most)]])
            if not len(fast):
                break
            work -= len(fast) * (level // 2) * self._operations
            coarse = samples[np.searchsorted(ids, fast)]
            self._on_time = self.track("fast trajectories, sampled more densely", level // 2)
            between = self._sampled(fast, np.linspace(*self.time_range, level + 1)[1::2])
            fine = _with_between(coarse, between)
            give_one_sign(fine)
            memory -= fine.nbytes
            self._misses[fast] = self._missed(fast, fine)
            self._levels[level], self._depth[fast] = (fast, fine), level
            ids, samples = fast, fine

    def _missed(self, ids: Ids, samples: Samples) -> npt.NDArray[np.float64]:
        """[M] squared errors of a frame by cubics through every second sample at the others, and by cubics through all
        samples at the probes; of the worst time."""
        between = self._visible(ids, _cubic_between(samples[:, ::2]) - samples[:, 1::2])
        got = _cubic_at(samples, self._probe_parts)
        probes = self._probes[ids]
        flipped = np.einsum("mtc,mtc->mt", got[..., QUATS], probes[..., QUATS]) < 0
        probes[..., QUATS] *= np.where(flipped, -1, 1)[..., None].astype(probes.dtype)
        return np.maximum(between, self._visible(ids, got - probes))

    def _visible(self, ids: Ids, differences: Samples) -> npt.NDArray[np.float64]:
        """[M] squared errors of a frame by differences of poses, [M, T, 10], at the worst time."""
        return np.square(differences @ self.roots[ids]).sum(axis=2, dtype=np.float64).max(axis=1)

    def _sampled(self, ids: Ids, times: np.ndarray) -> Samples:
        samples = np.empty((len(ids), len(times), POSE), np.float32)
        for i, t in enumerate(times.tolist()):
            samples[:, i] = self._sampler(t, ids)
            self._on_time()
        return samples


def layers_digest(baked: Baked) -> bytes:
    """SHA-256 of the layers."""
    digest = hashlib.sha256(repr(sorted(baked.moving.modulation)).encode())
    for layer in baked.layers:
        for name, values in layer.state_dict().items():
            digest.update(name.encode() + values.cpu().numpy().tobytes())
    return digest.digest()


def give_one_sign(samples: Samples) -> None:
    """Choose signs of quaternions along time so that each is closer to the one before: q and −q are one rotation."""
    quats = samples[..., QUATS]
    signs = np.where(np.einsum("mtc,mtc->mt", quats[:, 1:], quats[:, :-1]) < 0, -1, 1)
    quats[:, 1:] *= np.cumprod(signs, axis=1)[..., None].astype(samples.dtype)


def _cubic_between(samples: Samples) -> Samples:
    """[M, T − 1, 10] poses halfway between samples, by cubics through the nearest four."""
    inner = (9 * (samples[:, 1:-2] + samples[:, 2:-1]) - samples[:, :-3] - samples[:, 3:]) / 16
    first, last = (
        (5 * s[:, :1] + 15 * s[:, 1:2] - 5 * s[:, 2:3] + s[:, 3:4]) / 16 for s in (samples, samples[:, ::-1])
    )
    return np.concatenate([first, inner, last], axis=1)


def _cubic_at(samples: Samples, parts: np.ndarray) -> Samples:
    """[M, P, 10] poses at fractions of the time range, by cubics through the nearest four samples."""
    intervals = samples.shape[1] - 1
    first = np.clip(np.floor(parts * intervals).astype(int) - 1, 0, intervals - 3)
    x = parts * intervals - first
    nodes = np.arange(4)
    weights = [np.prod([(x - n) / (k - n) for n in nodes if n != k], axis=0) for k in nodes]
    total = np.zeros_like(samples[:, first])
    for k, weight in enumerate(weights):
        total += weight[:, None].astype(samples.dtype) * samples[:, first + k]
    return total


def _with_between(samples: Samples, between: Samples) -> Samples:
    merged = np.empty((len(samples), samples.shape[1] + between.shape[1], POSE), samples.dtype)
    merged[:, ::2], merged[:, 1::2] = samples, between
    return merged

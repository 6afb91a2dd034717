"""Poses of the moving Gaussians, sampled over time as densely as each of them needs.

All Gaussians are sampled at 65 times. Where errors of cubics between the samples are visible in frames, Gaussians are
sampled again twice as densely, and so on up to 2,049 times, so that only fast and visible motion costs more. Cubics are
compared at every second sample and at a few irregular times (probes), which detect motion with the period of the
samples.

The probes are taken in float64 and in float32. If float32 is close enough there, all other samples are taken in it: a
network of the paper's size needs ten seconds per time in float64, one to two in float32.
"""

import copy
import hashlib
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from export.jobs.bake import Baked
from export.measure.views import cameras_of_file
from export.progress import Track, no_progress
from export.trajectories.poses import MEANS, POSE, QUATS, SCALES, ExactPoses, Poses, SinglePoses, pixel
from export.trajectories.sensitivity import PASSES, sensitivities, square_roots
from msdgs_serve.scene.camera import Camera
from msdgs_serve.scene.errors import SceneFileInvalid

COARSE, FINEST = 64, 2048
"""Numbers of intervals between samples: of all Gaussians, and of the fastest."""

RESOLVED = 10 ** (-60 / 10)
"""Default of the squared error of a frame that cubics of all Gaussians together, each at its worst time, should not
exceed."""

VISIBLE = 10.0
"""Motion is too fast for the finest samples if cubics add so many times that error."""

FLOAT32_ENOUGH = 0.005
"""Largest error of float32 at the probes, pixels, with which all other samples are taken in it."""

PROBES = 9

WORK = 3e13
"""Largest number of operations for samples beyond the coarse ones: some minutes of two cores."""

MEMORY = 2 * 2**30
"""Largest size in bytes of samples beyond the coarse ones; Gaussians with the largest errors come first."""

Samples = npt.NDArray[np.floating]  # [M, T, 10] means, linear scales, unit quaternions of one sign along time
Ids = npt.NDArray[np.int64]
Made = TypeVar("Made")


class Trajectories:
    """Samples of one baked scene, used by all plans that are fitted to them."""

    def __init__(
        self, baked: Baked, track: Track = no_progress, cameras: Sequence[Camera] = (), resolved: float = RESOLVED
    ) -> None:
        """`cameras` show how visible errors are; by default those of the scene."""
        self.exact = ExactPoses(baked)
        self.count = self.exact.count
        self.time_range = baked.scene.metadata.time_range
        self.pixel = pixel(baked)
        self._ids = np.arange(self.count)  # in the arrays below
        self.track = track
        self._on_time = track(f"{self.count:,} trajectories", COARSE + 1 + PROBES)
        self._probe_parts = np.arange(1, PROBES + 1) * (np.sqrt(5) - 1) / 2 % 1
        self._sampler, self._probes = self._probed(baked)
        samples = self._sampled(self._ids, np.linspace(*self.time_range, COARSE + 1))
        give_one_sign(samples)
        self._levels = {COARSE: (self._ids, samples)}
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
        made.count, made._ids, made._whole = len(rows), self._ids[rows], self._whole or self
        return made

    @property
    def unresolved(self) -> Ids:
        """Gaussians that move faster than their finest sampling resolves."""
        return np.flatnonzero(np.isin(self._ids, self._missing(VISIBLE * self._resolved)))

    def intervals(self, ids: Ids) -> npt.NDArray[np.int64]:
        """[M] numbers of intervals between the samples of each."""
        return self._depth[self._ids[ids]]

    def on_grid(self, times: int, ids: Ids) -> Samples:
        """[M, T, 10] poses at T = 2ⁿ + 1 evenly spread times, interpolated by cubics between samples."""
        ids = self._ids[ids]
        got = np.empty((len(ids), times, POSE), np.float32)
        for level in np.unique(self._depth[ids]):
            rows = np.flatnonzero(self._depth[ids] == level)
            known, stored = self._levels[level]
            values = stored[np.searchsorted(known, ids[rows])]
            while values.shape[1] < times:
                values = _with_between(values, _cubic_between(values))
            got[rows] = values[:, :: (values.shape[1] - 1) // (times - 1)]
        return got

    @property
    def rows(self) -> Ids:
        """[M] indices of these Gaussians among those that were sampled."""
        return self._ids

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
            most = min(memory / ((level + 1) * POSE * 4), work / (level // 2 * self.exact.operations))
            fast = np.sort(fast[np.argsort(-self._misses[fast])[: int(most)]])
            if not len(fast):
                break
            work -= len(fast) * (level // 2) * self.exact.operations
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

    def _probed(self, baked: Baked) -> tuple[ExactPoses | SinglePoses, Samples]:
        """The sampler of all other times, and the samples at the probes."""
        t0, t1 = self.time_range
        probes = np.empty((self.count, PROBES, POSE), np.float32)
        single: SinglePoses | None = None
        with suppress(SceneFileInvalid):
            single = SinglePoses(baked)
        for i, t in enumerate(t0 + (t1 - t0) * self._probe_parts):
            probes[:, i] = exact = self.exact.at(float(t), self._ids)
            if single and not self._close(single, float(t), exact):
                single = None
            self._on_time()
        return single or self.exact, probes

    def _close(self, sampler: SinglePoses, t: float, exact: Poses) -> bool:
        try:
            single = sampler.at(t, self._ids)
        except SceneFileInvalid:
            return False
        signs = np.where(np.einsum("mc,mc->m", single[:, QUATS], exact[:, QUATS]) < 0, -1, 1)
        single[:, QUATS] *= signs[:, None]
        weights = _rotation_weights(exact[:, None], self.pixel)
        off = _distances(single[:, None] - exact[:, None], weights)
        return bool((off <= FLOAT32_ENOUGH * self.pixel).all())

    def _sampled(self, ids: Ids, times: np.ndarray) -> Samples:
        samples = np.empty((len(ids), len(times), POSE), np.float32)
        for i, t in enumerate(times):
            samples[:, i] = self._sampler.at(float(t), ids)
            self._on_time()
        return samples


def _distances(differences: np.ndarray, rotation_weights: np.ndarray) -> npt.NDArray[np.float64]:
    """[M] the largest of differences from poses, [M, T, 10], in scene units: of means, of scales, and of the end of the
    longest axis by a wrong rotation."""
    squares = np.square(differences)
    rotations = squares[..., QUATS].sum(-1).max(-1) * rotation_weights**2
    moves = squares[..., MEANS].sum(-1).max(-1)
    return np.sqrt(np.maximum(np.maximum(moves, rotations), squares[..., SCALES].max((-1, -2))))


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


def _rotation_weights(samples: Samples, pixel: float) -> npt.NDArray[np.float64]:
    """[M] scene units by which one unit of quaternion displaces the end of the longest axis.

    At least a thousandth of a pixel.
    """
    scales = samples[..., SCALES].astype(np.float64)
    return np.maximum(2 * (scales.max(-1) - scales.min(-1)).max(1, initial=0), 1e-3 * pixel)


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

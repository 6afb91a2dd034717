"""Poses of the moving Gaussians, sampled over time as densely as each of them needs.

All Gaussians are sampled at 65 times. Where a cubic misses a pose between them by more than a tenth of a pixel, that
Gaussian is sampled again twice as densely, and so on up to 2,049 times: a fast motion that a coarse sampling misses is
found at the times between, and only what moves fast pays for it. The times between are every second sample and a few
at irregular times, which detect motion with the period of the samples.

The times on no grid are sampled in float64 and in float32. Where float32 is as good as exact there, all other samples
are taken in it: a network of the paper's size takes ten seconds a time in float64, one to two in float32.
"""

import hashlib
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np
import numpy.typing as npt

from export.jobs.bake import Baked
from export.trajectories.poses import MEANS, POSE, QUATS, SCALES, ExactPoses, Poses, SinglePoses, pixel
from msdgs_serve.scene.errors import SceneFileInvalid

COARSE, USUAL, FINEST = 64, 512, 2048
"""Intervals between samples: of all Gaussians, for comparing fits, and of the fastest Gaussians."""

RESOLVED = 0.1
"""Largest error of a cubic between samples, pixels."""

FLOAT32_ENOUGH = 0.005
"""Largest error of float32 at the irregular times, pixels, for other samples to be taken in it."""

PROBES = 9
"""Number of irregular times."""

WORK = 1e14
"""Largest number of operations for samples beyond the coarse ones: about ten minutes of two cores."""

MEMORY = 2 * 2**30
"""Largest size in bytes of samples beyond the coarse ones; Gaussians with the largest errors come first."""

Samples = npt.NDArray[np.floating]  # [M, T, 10] means, linear scales, unit quaternions of one sign along time
Ids = npt.NDArray[np.int64]
OnTime = Callable[[int, int], object]


class Trajectories:
    """Samples of one baked scene, used by all plans that are fitted to them."""

    def __init__(self, baked: Baked, on_time: OnTime = lambda done, total: None) -> None:
        """`on_time(done, total)` is called after each time sampled; the total grows if motion is fast."""
        self.exact = ExactPoses(baked)
        self.count = self.exact.count
        self.time_range = baked.scene.metadata.time_range
        self.pixel = pixel(baked)
        self._done, self._total, self._on_time = 0, COARSE + 1 + PROBES, on_time
        self._probe_parts = np.arange(1, PROBES + 1) * (np.sqrt(5) - 1) / 2 % 1
        self._sampler, self._probes = self._probed(baked)
        samples = self._sampled(np.arange(self.count), np.linspace(*self.time_range, COARSE + 1))
        give_one_sign(samples)
        self._levels = {COARSE: (np.arange(self.count), samples)}
        self._depth = np.full(self.count, COARSE)  # intervals at which each is sampled
        self._fewest: dict[float, npt.NDArray[np.int64]] = {}  # by pixels
        self._misses = np.zeros(self.count)  # scene units, at the finest times between samples that were looked at
        self.rotation_weights = _rotation_weights(samples, self.pixel)
        self._refine()

    @property
    def unresolved(self) -> Ids:
        """Gaussians that move faster than their finest sampling resolves."""
        return np.flatnonzero(self._misses > RESOLVED * self.pixel)

    def checks(self, ids: Ids) -> npt.NDArray[np.int64]:
        """[M] at how many evenly spread times fits are compared with each of these Gaussians."""
        return np.maximum(self._depth[ids], USUAL) + 1

    def on_grid(self, times: int, ids: Ids) -> Samples:
        """[M, T, 10] poses at evenly spread times, a power of two of them and one more.

        Between the samples of a slow Gaussian a cubic through them.
        """
        got = np.empty((len(ids), times, POSE), np.float32)
        for level in np.unique(self._depth[ids]):
            rows = np.flatnonzero(self._depth[ids] == level)
            known, stored = self._levels[level]
            values = stored[np.searchsorted(known, ids[rows])]
            while values.shape[1] < times:
                values = _with_between(values, _cubic_between(values))
            got[rows] = values[:, :: (values.shape[1] - 1) // (times - 1)]
        return got

    def error_bound(self, errors: npt.NDArray[np.float64], own: int) -> dict[str, Any]:
        """The error bound of a fitted plan, given each Gaussian's largest error in scene units."""
        resolved = np.delete(errors, self.unresolved)
        return {
            "fitted": {
                "error": float(resolved.max(initial=0)),
                "pixel": self.pixel,
                "own_poses": own,
                "too_fast": len(self.unresolved),
                "too_fast_part": len(self.unresolved) / max(self.count, 1),
                "error_too_fast": float(errors[self.unresolved].max(initial=0)),
            }
        }

    def fewest_poses(self, most: float, ids: Ids) -> npt.NDArray[np.int64]:
        """[M] how many control points each needs to be within `most` pixels, where that was found before, or 0."""
        return self._fewest.get(most, np.zeros(self.count, np.int64))[ids]

    def remember_poses(self, most: float, ids: Ids, counts: npt.NDArray[np.int64]) -> None:
        """Store counts for other plans with the same error bound."""
        self._fewest.setdefault(most, np.zeros(self.count, np.int64))[ids] = counts

    def distances(self, ids: Ids, differences: np.ndarray) -> npt.NDArray[np.float64]:
        """[M] the largest of differences from poses, [M, T, 10], in scene units.

        Of means, of scales, and of how far a wrong rotation displaces the end of the longest axis.
        """
        return distances(differences, self.rotation_weights[ids])

    def _refine(self) -> None:
        ids, samples = self._levels[COARSE]
        self._misses[:] = self._missed(ids, samples)
        level, memory, work = COARSE, MEMORY, WORK
        while level < FINEST:
            level *= 2
            fast = np.flatnonzero((self._misses > RESOLVED * self.pixel) & (self._depth == level // 2))
            most = min(memory / ((level + 1) * POSE * 4), work / (level // 2 * self.exact.operations))
            fast = np.sort(fast[np.argsort(-self._misses[fast])[: int(most)]])
            if not len(fast):
                break
            work -= len(fast) * (level // 2) * self.exact.operations
            coarse = samples[np.searchsorted(ids, fast)]
            self._total += level // 2
            between = self._sampled(fast, np.linspace(*self.time_range, level + 1)[1::2])
            fine = _with_between(coarse, between)
            give_one_sign(fine)
            memory -= fine.nbytes
            self._misses[fast] = self._missed(fast, fine)
            self._levels[level], self._depth[fast] = (fast, fine), level
            ids, samples = fast, fine

    def _missed(self, ids: Ids, samples: Samples) -> npt.NDArray[np.float64]:
        """[M] how far cubics through samples are off: every second one from the others, and all from the probes."""
        between = self.distances(ids, _cubic_between(samples[:, ::2]) - samples[:, 1::2])
        got = _cubic_at(samples, self._probe_parts)
        probes = self._probes[ids]
        turned = np.einsum("mtc,mtc->mt", got[..., QUATS], probes[..., QUATS]) < 0
        probes[..., QUATS] *= np.where(turned, -1, 1)[..., None].astype(probes.dtype)
        return np.maximum(between, self.distances(ids, got - probes))

    def _probed(self, baked: Baked) -> tuple[ExactPoses | SinglePoses, Samples]:
        """What all other samples are taken with, and the samples at the times on no grid."""
        t0, t1 = self.time_range
        every, probes = np.arange(self.count), np.empty((self.count, PROBES, POSE), np.float32)
        single: SinglePoses | None = None
        with suppress(SceneFileInvalid):
            single = SinglePoses(baked)
        for i, t in enumerate(t0 + (t1 - t0) * self._probe_parts):
            probes[:, i] = exact = self.exact.at(float(t), every)
            if single and not self._close(single, float(t), exact):
                single = None
            self._tell()
        return single or self.exact, probes

    def _close(self, sampler: SinglePoses, t: float, exact: Poses) -> bool:
        try:
            single = sampler.at(t, np.arange(self.count))
        except SceneFileInvalid:
            return False
        turned = np.where(np.einsum("mc,mc->m", single[:, QUATS], exact[:, QUATS]) < 0, -1, 1)
        single[:, QUATS] *= turned[:, None]
        weights = _rotation_weights(exact[:, None], self.pixel)
        off = distances(single[:, None] - exact[:, None], weights)
        return bool((off <= FLOAT32_ENOUGH * self.pixel).all())

    def _tell(self) -> None:
        self._done += 1
        self._on_time(self._done, self._total)

    def _sampled(self, ids: Ids, times: np.ndarray) -> Samples:
        samples = np.empty((len(ids), len(times), POSE), np.float32)
        for i, t in enumerate(times):
            samples[:, i] = self._sampler.at(float(t), ids)
            self._tell()
        return samples


class SomeTrajectories(Trajectories):
    """Trajectories of some of the Gaussians of another set, those in `rows`."""

    def __init__(self, sampled: Trajectories, rows: Ids) -> None:
        self._source, self._rows = sampled, rows
        self.count, self.time_range, self.pixel = len(rows), sampled.time_range, sampled.pixel
        self.rotation_weights, self._misses = sampled.rotation_weights[rows], sampled._misses[rows]

    def checks(self, ids: Ids) -> npt.NDArray[np.int64]:
        """Of the other set."""
        return self._source.checks(self._rows[ids])

    def fewest_poses(self, most: float, ids: Ids) -> npt.NDArray[np.int64]:
        """Of the other set."""
        return self._source.fewest_poses(most, self._rows[ids])

    def remember_poses(self, most: float, ids: Ids, counts: npt.NDArray[np.int64]) -> None:
        """In the other set."""
        self._source.remember_poses(most, self._rows[ids], counts)

    def on_grid(self, times: int, ids: Ids) -> Samples:
        """Of the other set."""
        return self._source.on_grid(times, self._rows[ids])


def distances(differences: np.ndarray, rotation_weights: np.ndarray) -> npt.NDArray[np.float64]:
    """[M] the largest of differences from poses, [M, T, 10], as `Trajectories.distances` has it."""
    squares = np.square(differences)
    turns = squares[..., QUATS].sum(-1).max(-1) * rotation_weights**2
    moves = squares[..., MEANS].sum(-1).max(-1)
    return np.sqrt(np.maximum(np.maximum(moves, turns), squares[..., SCALES].max((-1, -2))))


_KEPT = 2
_recent: dict[bytes, Trajectories] = {}


def trajectories_of(baked: Baked) -> Trajectories:
    """Of the scene's moving Gaussians, sampled once for all plans; those of the last two scenes are cached."""
    digest = hashlib.sha256(repr((baked.scene.metadata.time_range, pixel(baked))).encode() + layers_digest(baked))
    m = baked.moving
    for values in (m.means, m.log_scales, m.quats, *m.modulation.values(), *m.attributes.values()):
        digest.update(values.tobytes())
    key = digest.digest()
    kept = _recent.pop(key, None) or Trajectories(baked)
    while len(_recent) >= _KEPT:
        del _recent[next(iter(_recent))]
    _recent[key] = kept
    return kept


def layers_digest(baked: Baked) -> bytes:
    """SHA-256 of the layers."""
    digest = hashlib.sha256(repr(sorted(baked.moving.modulation)).encode())
    for layer in baked.layers:
        for name, values in layer.state_dict().items():
            digest.update(name.encode() + values.cpu().numpy().tobytes())
    return digest.digest()


def give_one_sign(samples: Samples) -> None:
    """Flip signs along time so that each quaternion is nearer to the one before it: q and −q are one rotation."""
    quats = samples[..., QUATS]
    turned = np.where(np.einsum("mtc,mtc->mt", quats[:, 1:], quats[:, :-1]) < 0, -1, 1)
    quats[:, 1:] *= np.cumprod(turned, axis=1)[..., None].astype(samples.dtype)


def _rotation_weights(samples: Samples, pixel: float) -> npt.NDArray[np.float64]:
    """[M] scene units: how far one unit of quaternion displaces the end of the longest axis against a sphere.

    Turning a sphere changes nothing; at least a thousandth of a pixel, since plans divide by it.
    """
    scales = samples[..., SCALES].astype(np.float64)
    return np.maximum(2 * (scales.max(-1) - scales.min(-1)).max(1, initial=0), 1e-3 * pixel)


def _cubic_between(samples: Samples) -> Samples:
    """[M, T − 1, 10] halfway between samples: cubics through the nearest four."""
    inner = (9 * (samples[:, 1:-2] + samples[:, 2:-1]) - samples[:, :-3] - samples[:, 3:]) / 16
    first, last = (
        (5 * s[:, :1] + 15 * s[:, 1:2] - 5 * s[:, 2:3] + s[:, 3:4]) / 16 for s in (samples, samples[:, ::-1])
    )
    return np.concatenate([first, inner, last], axis=1)


def _cubic_at(samples: Samples, parts: np.ndarray) -> Samples:
    """[M, P, 10] at parts of the whole time: cubics through the nearest four samples."""
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

"""Levels of detail of trajectories: how many bytes each takes, and how visible its error is.

A pose is its mean over time plus r coefficients of the Gaussian times the first r of the functions of time that all
Gaussians share, or plus a spline of its own. A function has all ten numbers of a pose. Functions are the singular
vectors of all trajectories, weighted by how visible their errors are.
"""

import weakref
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt
from scipy.linalg import cholesky, eigh, solve_triangular

from msdgs_export.target import squared
from msdgs_export.trajectories.poses import MEANS, POSE, QUATS, SCALES
from msdgs_export.trajectories.sampling import Ids, Samples, Trajectories
from msdgs_export.trajectories.splines import along_time, design, fitting, samples_for
from msdgs_export.trajectories.stored import StoredPoses

RANKS = (0, 1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 256)
"""Numbers of coefficients."""

LEADING = 8
"""The first coefficients may be stored in 16 bits while all others are in 8."""

OWN = tuple((count, bits) for bits in (8, 16) for count in (7, 11, 19, 35, 67, 131, 259, 515))
"""Control points of a spline of one Gaussian, and bits of each of their numbers."""

KNOTS = (35, 67, 131)
"""Numbers of control points of shared functions."""

ENOUGH = squared(56)
"""Functions have the fewest control points with which they alone would add this squared error to a frame."""

SAMPLED = 2048
"""Number of Gaussians by which `KNOTS` are chosen."""

FEWEST_TIMES = 257
"""Times at which trajectories are compared; more if they are sampled more densely, or if control points are closer."""

PEAKS = 2.0
"""Errors over time count by a mean of this power, so that short errors count more. Measured: with 1 files of the same
PSNR on 48 frames are 15 % smaller, and brief motion is lost; with 4 they are 10 % larger."""

CHUNK = 1024
"""Gaussians that are compared at a time, fewer at more times."""

Errors = npt.NDArray[np.float64]


def sizes(num_ranks: int) -> npt.NDArray[np.float64]:
    """[L] bytes of a Gaussian at each level: of the first ranks, and of all splines of its own."""
    ranks = [rank + min(rank, LEADING) for rank in RANKS[:num_ranks]]
    return np.array([*ranks, *(POSE * (count * bits // 8 + 8) for count, bits in OWN)], float)


class Levels:
    """The levels of all Gaussians of one set of trajectories."""

    def __init__(self, trajectories: Trajectories) -> None:
        self._trajectories = weakref.proxy(trajectories)  # which keep what is made of them
        self._every, self._on_chunk = np.arange(trajectories.count), trajectories.track("levels of detail", 0)
        some = self._every[:: -(-len(self._every) // SAMPLED)]
        share = len(some) / len(self._every)
        enough = (n for n in KNOTS[:-1] if self._fit_errors(some, n).sum() <= ENOUGH * share)
        self.knots = next(enough, KNOTS[-1])
        self._own = np.full((len(OWN), trajectories.count), np.nan)
        variances = np.einsum("mcc->mc", trajectories.forms)
        totals = [max(float(variances[:, part].mean()), 1e-30) for part in (MEANS, SCALES, QUATS)]
        units = np.repeat(np.sqrt(np.array(totals) / totals[0]).clip(1e-6, 1e6), (3, 3, 4)).astype(np.float32)
        self._decompose(units, np.sqrt(variances[:, MEANS].mean(axis=1)))

    @property
    def num_ranks(self) -> int:
        """The number of ranks that there are functions for."""
        return len(self.errors)

    @property
    def bytes_per_function(self) -> float:
        """Bytes of one function."""
        return 2 * POSE * self.knots

    def own(self, ids: Ids, count: int) -> Samples:
        """[M, n, 10] control points of splines of some Gaussians, relative to their mean poses."""
        control = np.empty((len(ids), count, POSE), np.float32)
        for places, fitted, _, _ in self._fits(ids, count):
            control[places] = fitted - self.means[ids[places], None]
        return control

    def own_errors(self, ids: Ids, level: int) -> Errors:
        """[M] errors of some Gaussians with splines of one of the levels `OWN`; computed once."""
        new = ids[np.isnan(self._own[level, ids])]
        self._own[level, new] = self._fit_errors(new, *OWN[level])
        return self._own[level, ids]

    def _decompose(self, units: npt.NDArray[np.float32], visible: npt.NDArray[np.float32]) -> None:
        """Find functions, coefficients and errors, with `units` of poses, [10], and weights of Gaussians, [M]."""
        every, knots = self._every, self.knots
        control = np.empty((len(every), knots, POSE), np.float32)
        for places, fitted, _, _ in self._fits(every, knots):
            control[places] = fitted
        matrix = design(knots, FEWEST_TIMES)
        self.means = along_time(matrix.mean(axis=0, keepdims=True).astype(np.float32), control)[:, 0]
        """[M, 10] mean poses."""
        control -= self.means[:, None]
        root = cholesky(matrix.T @ matrix / len(matrix))  # of a squared mean over time
        chunks = np.array_split(every, -(-len(every) // CHUNK))

        def rows(ids: Ids) -> npt.NDArray[np.float32]:
            return (along_time(root.astype(np.float32), control[ids]) * units).reshape(len(ids), -1)

        gram = np.zeros((knots * POSE,) * 2)
        for ids in chunks:
            weighted = rows(ids) * visible[ids, None]
            gram += weighted.T @ weighted
        number = min(RANKS[-1], len(every), len(gram))
        functions = eigh(gram, subset_by_index=(len(gram) - number, len(gram) - 1))[1][:, ::-1].astype(np.float32)
        self.coefficients = np.concatenate([rows(ids) @ functions for ids in chunks])
        """[M, R]"""
        in_poses = solve_triangular(root, functions.reshape(knots, -1)).reshape(knots, POSE, number) / units[:, None]
        self.functions = np.ascontiguousarray(in_poses.transpose(0, 2, 1), np.float32)
        """[n, R, 10] control points of the functions, the most important first."""
        ranks = [rank for rank in RANKS if rank <= number]
        self.errors = np.empty((len(ranks), len(every)))
        """[ranks, M] what each adds to the squared error of a frame."""
        for places, times in self._chunks(every, FEWEST_TIMES):
            shown = np.tensordot(design(knots, times).astype(np.float32), self.functions, axes=1).transpose(1, 0, 2)
            got = self.means[places, None] - self._trajectories.on_grid(times, places)
            for level, (before, rank) in enumerate(zip([0, *ranks], ranks, strict=False)):
                got += np.tensordot(self.coefficients[places, before:rank], shown[before:rank], axes=1)
                self.errors[level, places] = self._visible(places, got)

    def _fit_errors(self, ids: Ids, count: int, bits: int | None = None) -> Errors:
        """[M] errors of splines of some Gaussians, relative to their mean poses if rounded to `bits`."""
        errors = np.empty(len(ids))
        for places, control, samples, times in self._fits(ids, count):
            means = 0 if bits is None else self.means[ids[places], None]
            stored = control if bits is None else StoredPoses.of(control - means, bits).control()
            shown = along_time(design(count, times).astype(np.float32), stored)
            errors[places] = self._visible(ids[places], shown + means - samples)
        return errors

    def _fits(self, ids: Ids, count: int) -> Iterator[tuple[Ids, Samples, Samples, int]]:
        """Places of some of the ids, control points of their splines, samples at evenly spread times, and their
        number."""
        fewest = samples_for(count)
        matrix = fitting(count, fewest).astype(np.float32)
        for places, times in self._chunks(ids, max(2 * fewest - 1, FEWEST_TIMES)):
            samples = self._trajectories.on_grid(times, ids[places])
            yield places, along_time(matrix, samples[:, :: (times - 1) // (fewest - 1)]), samples, times

    def _visible(self, ids: Ids, differences: Samples) -> Errors:
        """[M] squared errors of frames by differences of poses, [M, T, 10]: a mean over time of power `PEAKS`."""
        errors = np.square(differences @ self._trajectories.roots[ids]).sum(axis=2, dtype=np.float64)
        return (errors**PEAKS).mean(axis=1) ** (1 / PEAKS)

    def _chunks(self, ids: Ids, fewest: int) -> Iterator[tuple[Ids, int]]:
        """Places of some of the ids, and the number of times at which these are compared: all of their samples."""
        counts = np.maximum(self._trajectories.intervals(ids) + 1, fewest)
        for times in np.unique(counts):
            same = np.flatnonzero(counts == times)
            for places in np.array_split(same, max(-(-len(same) * times // (CHUNK * FEWEST_TIMES)), 1)):
                yield places, int(times)
                self._on_chunk()

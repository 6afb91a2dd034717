"""Which Gaussians keep poses of their own, so that the worst case of a plan is bounded and not only its mean."""

import numpy as np

from export.plans.splines import design, fitting, samples_for
from export.plans.stored_poses import OwnPoses, StoredPoses
from export.plans.trajectories import FINEST, Ids, Trajectories

COUNTS = (7, 11, 19, 35, 67, 131, FINEST // 2 + 3)
"""Control points of the grids that a Gaussian may have."""

SHARE = 0.05
"""Part of the Gaussians that a plan with a given size corrects: those that it gets most wrong."""

VISIBLE = 0.02
"""Pixels; a smaller error isn't corrected."""

CHUNK = 2048


def worst(trajectories: Trajectories, errors: np.ndarray, most: float | None) -> Ids:
    """Gaussians with larger errors than `most` pixels, or, without it, the worst 5 %."""
    if most is not None:
        return np.flatnonzero(errors > most * trajectories.pixel)
    over = np.flatnonzero(errors > VISIBLE * trajectories.pixel)
    return np.sort(over[np.argsort(-errors[over])[: int(np.ceil(SHARE * trajectories.count))]])


def own_poses(trajectories: Trajectories, ids: Ids, most: float) -> tuple[OwnPoses, np.ndarray]:
    """Poses of the Gaussians `ids`, each on the coarsest grid that is within `most` pixels, and their errors [H]."""
    errors = np.full(len(ids), np.inf)
    grids, left = [], np.arange(len(ids))
    for count in COUNTS:
        if not len(left):
            break
        control, found = fitted(trajectories, ids[left], count)
        done = (found <= most * trajectories.pixel) | (count == COUNTS[-1])
        if done.any():
            grids.append((left[done], StoredPoses.of(control[done])))
            errors[left[done]] = found[done]
        left = left[~done]
    return OwnPoses(ids, tuple(grids)), errors


def fitted(trajectories: Trajectories, ids: Ids, count: int) -> tuple[np.ndarray, np.ndarray]:
    """[M, n, 10] control points as stored, and the largest error of each Gaussian at all its samples, scene units."""
    times = samples_for(count)
    checks = FINEST + 1
    matrix, shown = fitting(count, times).astype(np.float32), design(count, checks).astype(np.float32)
    control = np.empty((len(ids), count, 10), np.float32)
    errors = np.empty(len(ids))
    for start in range(0, len(ids), CHUNK):
        rows = slice(start, start + CHUNK)
        samples = trajectories.on_grid(checks, ids[rows])
        control[rows] = np.matmul(matrix, samples[:, :: (checks - 1) // (times - 1)])
        stored = StoredPoses.of(control[rows]).control()
        errors[rows] = trajectories.distances(ids[rows], np.matmul(shown, stored) - samples)
    return control, errors

"""Splines whose number of control points per Gaussian follows from an error bound."""

import numpy as np

from export.trajectories.poses import POSE
from export.trajectories.sampling import FINEST, USUAL, Ids, Trajectories
from export.trajectories.splines import along_time, design, fitting, samples_for
from export.trajectories.stored import GriddedPoses, StoredPoses

COUNTS = (7, 11, 19, 35, 67, 131, 259, 515, FINEST // 2 + 3)
"""Possible numbers of control points of a Gaussian's spline."""

MAX_CORRECTED = 0.05
"""Fraction of the Gaussians, those with the largest errors, that a plan of a fixed size corrects."""

VISIBLE = 0.02
"""Smallest error that is corrected, pixels."""

BLOCK = 4096
"""Gaussians whose control points are held in float32 at a time."""

CHUNK = 2048
"""Gaussians that are fitted at a time, fewer if they are sampled more densely."""


def worst(trajectories: Trajectories, errors: np.ndarray, most: float | None) -> Ids:
    """Gaussians with larger errors than `most` pixels, or the worst 5 % if it is None."""
    if most is not None:
        return np.flatnonzero(errors > most * trajectories.pixel)
    over = np.flatnonzero(errors > VISIBLE * trajectories.pixel)
    return np.sort(over[np.argsort(-errors[over])[: int(np.ceil(MAX_CORRECTED * trajectories.count))]])


def adaptive_knots(trajectories: Trajectories, ids: Ids, most: float) -> tuple[GriddedPoses, np.ndarray]:
    """Poses of the Gaussians `ids`, each on the coarsest grid with an error up to `most` pixels, and the errors [H]."""
    errors, fewest = np.full(len(ids), np.inf), trajectories.fewest_poses(most, ids)
    grids, left = [], np.arange(len(ids))
    for count in COUNTS:
        rows, poses = [], []
        tried = left[fewest[left] <= count]
        for block in np.array_split(tried, -(-len(tried) // BLOCK)) if len(tried) else ():
            control, found = fitted(trajectories, ids[block], count)
            done = (found <= most * trajectories.pixel) | (count == COUNTS[-1])
            rows.append(block[done])
            poses.append(StoredPoses.of(control[done]))
            errors[block[done]] = found[done]
        done_rows = np.concatenate([left[:0], *rows])
        fewest[done_rows] = count
        if len(done_rows):
            grids.append((done_rows, StoredPoses.joined(poses)))
        left = np.setdiff1d(left, done_rows)
    trajectories.remember_poses(most, ids, fewest)
    return GriddedPoses(tuple(grids)), errors


def fitted(trajectories: Trajectories, ids: Ids, count: int) -> tuple[np.ndarray, np.ndarray]:
    """[M, n, 10] control points, and the largest error of each Gaussian at its samples, in scene units and including
    the rounding of stored control points."""
    control = np.empty((len(ids), count, POSE), np.float32)
    errors, checks = np.empty(len(ids)), np.maximum(trajectories.checks(ids), samples_for(count))
    for times in np.unique(checks):
        same = np.flatnonzero(checks == times)
        for rows in np.array_split(same, -(-len(same) * times // (CHUNK * USUAL))):
            control[rows], errors[rows] = _fitted(trajectories, ids[rows], count, int(times))
    return control, errors


def _fitted(trajectories: Trajectories, ids: Ids, count: int, checks: int) -> tuple[np.ndarray, np.ndarray]:
    """`fitted` for Gaussians that are compared at `checks` times."""
    samples, times = trajectories.on_grid(checks, ids), samples_for(count)
    matrix, shown = fitting(count, times).astype(np.float32), design(count, checks).astype(np.float32)
    control = along_time(matrix, samples[:, :: (checks - 1) // (times - 1)])
    stored = StoredPoses.of(control).control()
    return control, trajectories.distances(ids, along_time(shown, stored) - samples)

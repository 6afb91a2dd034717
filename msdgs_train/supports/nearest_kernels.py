"""Kernel of the nearest rows of a table, in any number of dimensions."""

import numpy as np

from msdgs_serve.rasterizer.jit import kernel


@kernel
def nearest_rows(points: np.ndarray, columns: np.ndarray, start: int, stop: int, ids: np.ndarray) -> None:
    """Write rows `start` to `stop` of ids [N, F]: of the F nearest of M centers, from the nearest to the farthest;
    of equally near ones the first.

    Args: points [N, D], columns [D, M] of the centers, M ≥ F.
    """
    dimensions, count = columns.shape
    followed, distances = ids.shape[1], np.empty(count, points.dtype)
    nearest = np.empty(followed, points.dtype)
    for n in range(start, stop):
        distances[:] = 0
        for d in range(dimensions):
            x = points[n, d]
            for m in range(count):
                distances[m] += (x - columns[d, m]) * (x - columns[d, m])
        nearest[:] = np.inf
        for m in range(count):
            distance, k = distances[m], followed
            if not distance < nearest[followed - 1]:
                continue
            while k > 0 and distance < nearest[k - 1]:
                k -= 1
            for later in range(followed - 1, k, -1):
                nearest[later], ids[n, later] = nearest[later - 1], ids[n, later - 1]
            nearest[k], ids[n, k] = distance, m

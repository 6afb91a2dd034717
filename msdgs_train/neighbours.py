"""Which points of a cloud are near which."""

import torch
from torch import Tensor

from msdgs_serve.scene.errors import InvalidInput


def nearest(points: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Distances, [N, k], and indices, int64 [N, k], of the nearest other points of each, the nearest first.

    k is `count`, or N − 1 where there are no more. Coincident points are at distance 0 of one another.
    """
    n = len(points)
    broken = int((~torch.isfinite(points)).any(dim=1).sum())
    if broken:
        raise InvalidInput("points", "finite", f"{broken} of {n} with NaN or infinity")
    k = max(min(count, n - 1), 0)
    if k == 0:
        return points.new_zeros(n, 0), torch.zeros(n, 0, dtype=torch.int64)
    from scipy.spatial import KDTree  # not wanted to load a model, so not in the export extra

    positions = points.detach().cpu().numpy()
    distances, indices = KDTree(positions).query(positions, k=k + 1)
    distances, indices = torch.from_numpy(distances), torch.from_numpy(indices)
    # a point is its own nearest, but any of several at the same place may come first
    own = indices == torch.arange(n)[:, None]
    own[:, -1] |= ~own.any(dim=1)
    return distances[~own].reshape(n, k).to(points), indices[~own].reshape(n, k).to(points.device)

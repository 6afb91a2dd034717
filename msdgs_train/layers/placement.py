"""Places among points."""

import torch
from torch import Tensor
from torch.nn.functional import one_hot

ROUNDS = 10
"""Of k-means."""


def farthest_points(points: Tensor, count: int, first: int) -> tuple[Tensor, Tensor]:
    """Farthest-point sampling: [count] ids of N points, [N, D], each the farthest from those before it, and the
    distance of every point, [N], to the nearest of them."""
    chosen, ids = first, []
    distances = points.new_full((len(points),), torch.inf)
    for _ in range(count):
        ids.append(chosen)
        distances = torch.minimum(distances, (points - points[chosen]).norm(dim=1))
        chosen = int(distances.argmax())
    return torch.tensor(ids, device=points.device), distances


def spread_centers(points: Tensor, count: int) -> Tensor:
    """[count, D] means of groups of points, [N, D], by k-means from points that are far from each other."""
    middle = int((points - points.mean(dim=0)).norm(dim=1).argmin())
    centers = points[farthest_points(points, count, middle)[0]]
    for _ in range(ROUNDS):
        members = one_hot(torch.cdist(points, centers).argmin(dim=1), count).to(points.dtype)
        sizes = members.sum(dim=0)[:, None]
        centers = torch.where(sizes > 0, members.T @ points / sizes.clamp_min(1), centers)
    return centers

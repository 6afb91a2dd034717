"""Losses of the motion of control nodes, as SC-GS computes them: their positions at several times, [T, M, 3]."""

import torch
from torch import Tensor

from msdgs_train.layers.arrays import to_device
from msdgs_train.layers.chain import MultiStepDeformation
from msdgs_train.supports.nearest import nearest

RIGID_NEIGHBORS = 10
ALWAYS_RIGID = 3
"""Nearest neighbors that stay however far they are."""
RIGID_RADIUS = 0.1
"""Scene units; neighbors farther away than this are left out."""
RIGID_SAMPLES = 512
"""Nodes that as-rigid-as-possible looks at, at most."""
MIN_SCALE = 1e-5
"""Added to the divisors of losses that are relative to themselves: they have the gradient of a logarithm."""


def trajectories(chain: MultiStepDeformation, points: Tensor, times: Tensor) -> Tensor:
    """[T, M, 3] positions of points, [M, 3], at times, [T]."""
    return torch.stack([points + chain(points, t).means for t in times])


def near_time(t: float, width: float, generator: torch.Generator) -> float:
    """A time, uniform in an interval of `width` around `t`."""
    return t + width * (float(torch.rand((), generator=generator)) - 0.5)


def sampled_times(center: float, width: float, count: int, generator: torch.Generator) -> Tensor:
    """[count] times, uniform in an interval of `width` around `center`."""
    return center + width * (torch.rand(count, generator=generator) - 0.5)


def elastic_loss(positions: Tensor, weights: Tensor, ids: Tensor) -> Tensor:
    """Variance over time of the distances to neighbors, weights and ids of which are [M, K], relative to itself."""
    lengths = (positions[:, ids] - positions[:, :, None]).norm(dim=3)  # [T, M, K]
    variance = lengths.var(dim=0)
    return (variance / (variance.detach() + MIN_SCALE) * weights).sum(dim=1).mean()


def acceleration_loss(positions: Tensor) -> Tensor:
    """Second difference of the positions at three times, relative to itself."""
    sizes = (positions[0] + positions[2] - 2 * positions[1]).norm(dim=1)
    return (sizes / (sizes.detach() + MIN_SCALE)).mean()


def rigidity_loss(positions: Tensor, generator: torch.Generator) -> Tensor:
    """As rigid as possible (Sorkine and Alexa 2007): squared differences of edges at each later time from those at the
    first, rotated by the rotation of a node that fits best; a sum over nodes, edges and times."""
    first = positions[0].detach()
    ids = nearest(first, first, RIGID_NEIGHBORS + 1)[:, 1:]
    is_near = (first[ids] - first[:, None]).norm(dim=2) < RIGID_RADIUS
    is_near[:, :ALWAYS_RIGID] = True
    rows = torch.arange(len(first), device=first.device)
    if len(first) > RIGID_SAMPLES:
        rows = to_device(torch.randint(len(first), (RIGID_SAMPLES,), generator=generator), first.device)
    edges = is_near[rows, :, None] * (positions[:, rows, None] - positions[:, ids[rows]])  # [T, M, K, 3]
    total = positions.new_zeros(())
    for later in edges[1:]:
        turned = edges[0] @ fitted_rotations(edges[0], later).mT
        total = total + (later - turned).square().sum()
    return total


@torch.no_grad()
def fitted_rotations(edges: Tensor, moved: Tensor) -> Tensor:
    """[M, 3, 3] the rotations that take edges, [M, K, 3], nearest to those that moved, by a singular value
    decomposition; the identity where a coordinate of no edge has changed, which also avoids one of zeros."""
    products = edges.mT @ moved
    is_still = (edges == moved).all(dim=1).any(dim=1)
    left, _, right = torch.linalg.svd(torch.where(is_still[:, None, None], 0.0, products))
    signs = torch.ones_like(left[:, 0])
    signs[:, 2] = torch.linalg.det(left @ right).sign()  # singular values descend: the smallest is flipped
    return right.mT @ (signs[:, :, None] * left.mT)

"""Quaternions that are not scaled to unit length after their deltas, as Deformable-3D-Gaussians draws them.

Its rasterizer takes the matrix of a unit quaternion of any: if the norm isn't 1, that is no rotation but shears. What
is drawn is an ellipsoid all the same, and so has a unit quaternion and scales.
"""

from typing import Literal

import torch
from torch import Tensor

from msdgs_train.gaussians.scale_space import MIN_SCALE
from msdgs_train.layers.quaternions import rotation_matrices, unit_or_identity

QuatSpace = Literal["unit", "raw"]

SWEEPS = 5
"""Each turns the three pairs of axes until they are at right angles; angles fall with the square, from 1 at most."""
PAIRS = ((0, 1), (0, 2), (1, 2))
LEAST = 1e-30  # added to what is divided by
LARGE = 0.99  # of 4 q_i², whose largest is 1 or more


def unit_form(quats: Tensor, scales: Tensor) -> tuple[Tensor, Tensor]:
    """Unit quaternions, [N, 4], and scales, [N, 3], of the ellipsoids that any quaternions and scales above 0 give.

    One-sided Jacobi rotations: the half-axes, the columns of R(q) S, keep their order and nearly their directions if
    norms are nearly 1. Directions are not determined where scales are equal.
    """
    axes = list((rotation_matrices(quats) * scales[:, None]).unbind(dim=2))
    for _ in range(SWEEPS):
        for i, j in PAIRS:
            axes[i], axes[j] = _turned(axes[i], axes[j])
    lengths = torch.stack([torch.linalg.vector_norm(axis, dim=1) for axis in axes], dim=1)
    a, b, c = (axis / length[:, None].clamp_min(LEAST) for axis, length in zip(axes, lengths.unbind(1), strict=True))
    return _quaternions(a, b, c), lengths.clamp_min(MIN_SCALE)


def _turned(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """Two half-axes of the same ellipse at right angles, turned by 45° at most."""
    product, difference = (2 * a * b).sum(dim=1), (b * b - a * a).sum(dim=1)
    sign = torch.where(difference < 0, -1.0, 1.0)
    tangent = sign * product / (difference.abs() + torch.hypot(difference, product) + LEAST)
    cosine = torch.rsqrt(1 + tangent * tangent)[:, None]
    sine = tangent[:, None] * cosine
    return cosine * a - sine * b, sine * a + cosine * b


def _quaternions(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """[N, 4] wxyz of rotation matrices with these columns: 4 q_i q of the first q_i that is large enough."""
    (xx, yx, zx), (xy, yy, zy), (xz, yz, zz) = (axis.unbind(dim=1) for axis in (a, b, c))
    rows = (
        (1 + xx + yy + zz, zy - yz, xz - zx, yx - xy),
        (zy - yz, 1 + xx - yy - zz, xy + yx, xz + zx),
        (xz - zx, xy + yx, 1 - xx + yy - zz, yz + zy),
        (yx - xy, xz + zx, yz + zy, 1 - xx - yy + zz),
    )
    found = torch.stack(rows[3], dim=1)
    for i in (2, 1, 0):
        row = torch.stack(rows[i], dim=1)
        found = torch.where(row[:, i : i + 1] < LARGE, found, row)
    return unit_or_identity(found)

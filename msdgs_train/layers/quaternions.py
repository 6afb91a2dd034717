"""Quaternions [N, 4], wxyz, and symmetric matrices, differentiable."""

from functools import cache
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from msdgs_serve.scene.quaternion import MIN_NORM, to_matrix
from msdgs_train.layers import arrays
from msdgs_train.layers.arrays import to_array
from msdgs_train.layers.quaternion_kernels import unit_backward, unit_forward


def unit(quats: Tensor) -> Tensor:
    """Scaled to unit length; those of norm under 1e-8 vanish."""
    return quats / torch.linalg.vector_norm(quats, dim=1, keepdim=True).clamp_min(MIN_NORM)


def unit_or_identity(raw_quats: Tensor) -> Tensor:
    """Scaled to unit length; those of norm under 1e-8 have no direction and become the identity."""
    return _Unit.apply(raw_quats) if arrays.has_kernels(raw_quats) else _unit_or_identity(raw_quats)


def identity_like(quats: Tensor) -> Tensor:
    """[1, 4] the identity; don't write to it."""
    return _identity(1, 4, quats.dtype, quats.device)


def _unit_or_identity(raw: Tensor) -> Tensor:
    norms = torch.linalg.vector_norm(raw, dim=1, keepdim=True)
    directed = norms >= MIN_NORM
    return torch.where(directed, raw / torch.where(directed, norms, 1.0), identity_like(raw))


class _Unit(torch.autograd.Function):
    """By kernels; with torch's operations a training step takes 1.1 times as long."""

    @staticmethod
    def forward(ctx: Any, raw: Tensor) -> Tensor:
        ctx.save_for_backward(raw)
        array = to_array(raw)
        units = np.empty_like(array)
        unit_forward(array, units)
        return torch.from_numpy(units).to(raw.device)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Tensor:  # type: ignore[override]
        raw = to_array(ctx.saved_tensors[0])
        grad_raw = np.empty_like(raw)
        unit_backward(raw, to_array(grad), grad_raw)
        return torch.from_numpy(grad_raw).to(grad.device)


def conjugate(quats: Tensor) -> Tensor:
    """The inverses of unit quaternions."""
    return torch.cat([quats[:, :1], -quats[:, 1:]], dim=1)


def multiply(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton products: first b rotates, then a."""
    (aw, av), (bw, bv) = (q.split((1, 3), dim=1) for q in (a, b))
    vector = aw * bv + bw * av + torch.linalg.cross(av, bv)
    return torch.cat([aw * bw - (av * bv).sum(dim=1, keepdim=True), vector], dim=1)


def rotate(quats: Tensor, vectors: Tensor) -> Tensor:
    """Vectors [N, 3] rotated by unit quaternions."""
    w, axis = quats[:, :1], quats[:, 1:]
    twice = 2 * torch.linalg.cross(axis, vectors)
    return vectors + w * twice + torch.linalg.cross(axis, twice)


def rotation_matrices(quats: Tensor) -> Tensor:
    """[N, 3, 3] of unit quaternions."""
    products = (quats[:, :, None] * quats[:, None]).flatten(1)
    identity = _identity(3, 3, quats.dtype, quats.device).flatten()
    return torch.addmm(identity, products, _product_terms(quats.dtype, quats.device)).unflatten(1, (3, 3))


@cache
def _identity(rows: int, columns: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    return torch.eye(rows, columns, dtype=dtype, device=device)


@cache
def _product_terms(dtype: torch.dtype, device: torch.device) -> Tensor:
    """[16, 9] what each product of two components adds to a rotation matrix: half of what both orders of it do."""
    units = np.eye(4)
    alone = to_matrix(units) - np.eye(3)
    sums = to_matrix((units[:, None] + units).reshape(16, 4)) - np.eye(3)
    terms = (sums.reshape(4, 4, 9) - alone.reshape(4, 1, 9) - alone.reshape(4, 9)) / 2
    return torch.from_numpy(terms.reshape(16, 9)).to(device, dtype)


def stretch_matrices(stretches: Tensor) -> Tensor:
    """[N, 3, 3] the identity plus symmetric matrices of xx, yy, zz, xy, xz, yz, [N, 6], or diagonal ones, [N, 3]."""
    dtype, device = stretches.dtype, stretches.device
    terms = _stretch_terms(dtype, device)[: stretches.shape[1]]
    return torch.addmm(_identity(3, 3, dtype, device).flatten(), stretches, terms).unflatten(1, (3, 3))


@cache
def _stretch_terms(dtype: torch.dtype, device: torch.device) -> Tensor:
    """[6, 9] where the six numbers of a symmetric matrix are in it."""
    places = np.array([[0, 3, 4], [3, 1, 5], [4, 5, 2]])
    return torch.from_numpy(np.eye(6)[:, places.flatten()]).to(device, dtype)

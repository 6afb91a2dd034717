"""The amplification of errors by a chain of layers, and the error of float32 that follows from it.

Layer k moves a point by x_k = x_{k-1} + w_k f_k(x_{k-1}, t) (equation 8). A small error before layer k is multiplied by
the product of the later Jacobians, J_K … J_{k+1} with J = I + ∂(w f)/∂x. Each is 3 × 3 per point, and the rows of a
batch are independent, so three backward passes through a layer give it exactly for all points at once. Deltas of scales
and rotations, which displace the Gaussians that follow a node, are sums over layers: ten more passes give theirs.
"""

import itertools
import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from msdgs_train.gaussians.model import DynamicGaussians, canonical_points
from msdgs_train.layers.base import DeformationLayer
from msdgs_train.layers.chain import Deltas, MultiStepDeformation

UNIT_ROUNDOFF = 2.0**-24
"""Largest relative error of one rounding to float32."""

MEANS, SCALES, QUATS = slice(0, 3), slice(3, 9), slice(9, 13)  # columns of the sums over layers
OFF_DIAGONAL = slice(6, 9)  # xy, xz, yz of stretch tensors: twice in a matrix, so √2 times in its Frobenius norm


class Growth(NamedTuple):
    """Error growth of M Gaussians at one time through K layers, in float64."""

    after: np.ndarray  # [K, M] ‖J_k … J_1‖: growth of a displacement of the canonical mean after layer k
    amplification: np.ndarray  # [M] the largest ‖J_j … J_i‖ of products that end at the last layer, at least 1
    predicted: np.ndarray  # [M] bound to first order of the error of the float32 mean


class PointGrowth(NamedTuple):
    """Error growth of P points, Gaussians or control nodes, at one time through K layers, in float64."""

    after: list[Tensor]  # K of [P], as of `Growth`
    amplification: Tensor  # [P]
    errors: Tensor  # [P, 1] bound of the error of x_K in float32; or also of the sums of wΔS, wΔR and extra heads


def growth(double: DynamicGaussians, single: DynamicGaussians, ids: Tensor, t: float) -> Growth:
    """Growth of the Gaussians `ids`, int64 [M], of a model in float64 and in float32.

    On control nodes it is that of the nodes that a Gaussian follows; errors of their translations, stretches and
    rotations displace the Gaussian with its lever arms.
    """
    points = canonical_points(double.gaussians.rows(ids))
    support, on_nodes = double.support, double.support.num_points is not None
    start = support.points(points.means)
    parts = _summed_parts(double.config.support.extra_heads) if on_nodes else (MEANS,)
    found = through_layers(double.deformation, single.deformation, start, t, parts)
    predicted = found.errors[:, 0]
    with torch.no_grad():
        if on_nodes:
            deltas = double.deformation(start, torch.tensor(t, dtype=start.dtype))
            predicted = support.mean_error_bounds(found.errors, deltas, points)
            predicted += _following_error(double, single, ids, t)
        after = [support.spread(values, points).numpy() for values in found.after]
        amplification = support.spread(found.amplification, points).numpy()
    predicted = torch.nan_to_num(predicted, nan=math.inf, posinf=math.inf).numpy()
    return Growth(np.array(after).reshape(-1, len(ids)), amplification, predicted)


def _summed_parts(extra_heads: Mapping[str, int]) -> tuple[slice, ...]:
    """Columns of the sums over layers: of means, scales, quaternions and each extra head."""
    ends = itertools.accumulate(extra_heads.values(), initial=QUATS.stop)
    return (MEANS, SCALES, QUATS, *itertools.starmap(slice, itertools.pairwise(ends)))


def through_layers(
    double: MultiStepDeformation,
    single: MultiStepDeformation,
    means: Tensor,
    t: float,
    parts: tuple[slice, ...] = (MEANS,),
) -> PointGrowth:
    """Follow float64 `means`, [P, 3], through the layers at time `t`; `single` are the same layers in float32.

    δ_k is the error of layer k alone, measured from the same float32 means in both precisions, and u‖x_k‖ the error of
    rounding its results. To first order Σ_k ‖J_K … J_{k+1}‖ · (δ_k + u‖x_k‖) bounds the error of the whole chain. The
    sums of other deltas, of the `parts` of their columns, have own errors, and others because the layers read inexact
    positions.
    """
    sums = pad(means.detach(), (0, parts[-1].stop - 3))
    jacobians, own_errors = [], []
    for layer, rounded in zip(double, single, strict=True):
        own = _own_error(layer, rounded, sums, t)
        sums, jacobian = _moved_and_jacobian(layer, sums, t)
        own += UNIT_ROUNDOFF * sums.abs()
        for values in (own, jacobian):
            values[:, OFF_DIAGONAL] *= math.sqrt(2)
        own_errors.append(torch.stack([torch.linalg.vector_norm(own[:, part], dim=1) for part in parts], dim=1))
        jacobians.append(jacobian)
    after, product = [], torch.eye(3, dtype=means.dtype).expand(len(means), 3, 3)
    for jacobian in jacobians:
        product = jacobian[:, MEANS] @ product
        after.append(spectral_norm(product))
    amplification, errors = means.new_ones(len(means)), means.new_zeros(len(means), len(parts))
    product = torch.eye(sums.shape[1], 3, dtype=means.dtype).expand(len(means), -1, 3)  # of all sums by the position
    for jacobian, own in zip(reversed(jacobians), reversed(own_errors), strict=True):
        errors += torch.stack([spectral_norm(product[:, part]) for part in parts], dim=1) * own[:, :1]
        errors[:, 1:] += own[:, 1:]
        product = product @ jacobian[:, MEANS] + pad(jacobian[:, 3:], (0, 0, 3, 0))
        amplification = torch.maximum(amplification, spectral_norm(product[:, MEANS]))
    return PointGrowth(after, amplification, errors)


def spectral_norm(matrices: Tensor) -> Tensor:
    """[M] largest singular value of each of [M, ·, 3]; infinite if an entry is NaN or infinite."""
    finite = torch.isfinite(matrices).all(dim=2).all(dim=1)
    norms = torch.linalg.matrix_norm(torch.where(finite[:, None, None], matrices, 0), ord=2)
    return torch.where(finite, norms, math.inf)


def _moved(layer: DeformationLayer, sums: Tensor, t: float) -> Tensor:
    """Sums over the layers before, [P, 3], or of all deltas side by side, plus those of this layer."""
    step = layer(sums[:, MEANS], torch.tensor(t, dtype=sums.dtype))
    scales = pad(step.delta_scales, (0, 6 - step.delta_scales.shape[1]))
    deltas = torch.cat([step.delta_means, scales, step.delta_quats, *step.extra.values()], dim=1)
    return torch.addcmul(sums, step.weight, deltas[:, : sums.shape[1]])


def _moved_and_jacobian(layer: DeformationLayer, sums: Tensor, t: float) -> tuple[Tensor, Tensor]:
    """The sums after a layer, [P, C], and their derivative with respect to the position before it, [P, C, 3]."""
    columns = sums.shape[1]
    with torch.enable_grad():
        start = sums[:, MEANS].detach().requires_grad_()
        moved = _moved(layer, torch.cat([start, sums[:, 3:]], dim=1), t) + 0 * start[:, :1]  # a layer may not read it
        rows = [torch.autograd.grad(moved[:, i].sum(), start, retain_graph=i + 1 < columns)[0] for i in range(columns)]
    return moved.detach(), torch.stack(rows, dim=1)


@torch.no_grad()
def _own_error(layer: DeformationLayer, rounded: DeformationLayer, sums: Tensor, t: float) -> Tensor:
    """[P, C] errors of a layer's float32 result, from the same float32 sums in both precisions."""
    start = sums.float()
    return (_moved(rounded, start, t).double() - _moved(layer, start.double(), t)).abs()


def _following_error(double: DynamicGaussians, single: DynamicGaussians, ids: Tensor, t: float) -> Tensor:
    """[M] errors of float32 means that follow the same float32 deltas of the nodes in both precisions."""
    deltas = single.deformation(single.support.points(single.gaussians.means), torch.tensor(t))
    exact = Deltas(*(values.double() for values in deltas[:3]), extra={n: v.double() for n, v in deltas.extra.items()})
    moved = []
    for model, rounded in ((single, deltas), (double, exact)):
        points = canonical_points(model.gaussians.rows(ids))
        moved.append(points.means + model.support.follow(points, model.support.transforms(rounded)).means)
    return torch.linalg.vector_norm(moved[0].double() - moved[1], dim=1)

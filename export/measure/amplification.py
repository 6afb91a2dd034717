"""The amplification of errors by a chain of layers, and the error of float32 that follows from it.

Layer k moves a Gaussian by x_k = x_{k-1} + w_k f_k(x_{k-1}, t) (equation 8). A small error before layer k is multiplied
by the product of the later Jacobians, J_K … J_{k+1} with J = I + ∂(w f)/∂x. Each is 3 × 3 per Gaussian, and the rows
of a batch are independent, so three backward passes through a layer give it exactly for all Gaussians at once.
"""

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from msdgs_train.layers.chain import MultiStepDeformation
from msdgs_train.layers.deformation import DeformationLayer

UNIT_ROUNDOFF = 2.0**-24
"""Largest relative error of one rounding to float32."""


class Growth(NamedTuple):
    """Error growth of M points, Gaussians or control nodes, at one time through K layers, in float64."""

    after: np.ndarray  # [K, M] ‖J_k … J_1‖: growth of a displacement of the canonical mean after layer k
    amplification: np.ndarray  # [M] the largest ‖J_j … J_i‖ of products that end at the last layer, at least 1
    predicted: np.ndarray  # [M] expected distance of the float32 mean: Σ_k ‖J_K … J_{k+1}‖ · (δ_k + u‖x_k‖)


def growth(double: MultiStepDeformation, single: MultiStepDeformation, means: Tensor, t: float) -> Growth:
    """Follow float64 `means`, [M, 3], through the layers at time `t`; `single` are the same layers in float32.

    δ_k is the error of layer k alone, measured from the same float32 means in both precisions, and u‖x_k‖ the error of
    rounding its results. To first order their amplified sum bounds the error of the whole chain.
    """
    positions, jacobians, own_errors = means.detach(), [], []
    for layer, rounded in zip(double, single, strict=True):
        own_errors.append(_own_error(layer, rounded, positions, t))
        positions, jacobian = _moved_and_jacobian(layer, positions, t)
        own_errors[-1] += UNIT_ROUNDOFF * torch.linalg.vector_norm(positions, dim=1)
        jacobians.append(jacobian)
    after, product = [], torch.eye(3, dtype=means.dtype).expand(len(means), 3, 3)
    for jacobian in jacobians:
        product = jacobian @ product
        after.append(spectral_norm(product))
    amplification = torch.ones(len(means), dtype=means.dtype)
    predicted = torch.zeros(len(means), dtype=means.dtype)
    product = torch.eye(3, dtype=means.dtype).expand(len(means), 3, 3)
    for jacobian, error in zip(reversed(jacobians), reversed(own_errors), strict=True):
        predicted += spectral_norm(product) * error
        product = product @ jacobian
        amplification = torch.maximum(amplification, spectral_norm(product))
    stacked = torch.stack(after) if after else means.new_ones((0, len(means)))
    predicted = torch.nan_to_num(predicted, nan=math.inf, posinf=math.inf)
    return Growth(stacked.numpy(), amplification.numpy(), predicted.numpy())


def spectral_norm(matrices: Tensor) -> Tensor:
    """[M] largest singular value of each of [M, 3, 3]; infinite if an entry is NaN or infinite."""
    finite = torch.isfinite(matrices).all(dim=2).all(dim=1)
    norms = torch.linalg.matrix_norm(torch.where(finite[:, None, None], matrices, 0), ord=2)
    return torch.where(finite, norms, math.inf)


def _moved(layer: DeformationLayer, means: Tensor, t: float) -> Tensor:
    """[M, 3] x + w f(x, t)."""
    step = layer(means, torch.tensor(t, dtype=means.dtype))
    return torch.addcmul(means, step.weight, step.delta_means)


def _moved_and_jacobian(layer: DeformationLayer, means: Tensor, t: float) -> tuple[Tensor, Tensor]:
    """x + w f(x, t), [M, 3], and its derivative with respect to x, [M, 3, 3]."""
    with torch.enable_grad():
        start = means.detach().requires_grad_()
        moved = _moved(layer, start, t) + 0 * start  # a layer may not read the means
        rows = [torch.autograd.grad(moved[:, i].sum(), start, retain_graph=i < 2)[0] for i in range(3)]
    return moved.detach(), torch.stack(rows, dim=1)


@torch.no_grad()
def _own_error(layer: DeformationLayer, rounded: DeformationLayer, means: Tensor, t: float) -> Tensor:
    """[M] distance of a layer's float32 result from its float64 one, both from the same float32 means."""
    start = means.float()
    exact = _moved(layer, start.double(), t)
    return torch.linalg.vector_norm(_moved(rounded, start, t).double() - exact, dim=1)

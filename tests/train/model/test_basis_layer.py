"""Motion bases: splines, turns, blends, where they begin, and how they go on where nothing is known yet."""

from typing import Any

import numpy as np
import pytest
import torch
from scipy.interpolate import BSpline
from scipy.spatial.transform import Rotation

from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.gaussians.config import ModelConfig
from msdgs_train.supports.nodes import BasisLayer, SkinningInputs, cubic_weights, product, rotation_matrices
from msdgs_train.supports.skinning_kernels import K_NEAREST, LEAST_STRETCH
from tests.support.models import random_model
from tests.support.tolerances import tolerance

EXACT = tolerance("rotation")


def layer_of(count: int = 3, knots: int = 5, time_range: tuple[float, float] = (0.0, 1.0)) -> BasisLayer:
    generator = torch.Generator().manual_seed(1)
    layer = BasisLayer(count, knots, time_range).double()
    with torch.no_grad():
        layer.shifts.add_(0.3 * torch.randn(layer.shifts.shape, generator=generator, dtype=torch.float64))
        layer.turns.add_(0.5 * torch.randn(layer.turns.shape, generator=generator, dtype=torch.float64))
        layer.stretches.add_(0.2 * torch.randn(layer.stretches.shape, generator=generator, dtype=torch.float64))
        layer.pivots.add_(torch.randn(layer.pivots.shape, generator=generator, dtype=torch.float64))
    return layer


def carried_of(count: int, motions: int) -> SkinningInputs:
    generator = torch.Generator().manual_seed(2)
    means, quats, logits = (
        torch.randn(count, columns, generator=generator, dtype=torch.float64) for columns in (3, 4, motions)
    )
    ids = torch.stack([torch.randperm(motions, generator=generator) for _ in range(count)])
    return SkinningInputs(means, quats / quats.norm(dim=1, keepdim=True), logits.softmax(dim=1), ids)


def time(t: float) -> torch.Tensor:
    return torch.tensor(t, dtype=torch.float64)


def as_rotation(quat: torch.Tensor) -> Rotation:
    return Rotation.from_quat(quat.detach().numpy()[..., [1, 2, 3, 0]])


@pytest.mark.parametrize("t", [2.0, 2.013, 3.1, 4.49, 4.5])
def test_motions_are_on_splines(t: float) -> None:
    layer = layer_of(time_range=(2.0, 4.5))
    knots = np.arange(-3, 9) / 5 * 2.5 + 2
    curves = torch.cat([layer.shifts, layer.turns, layer.stretches], dim=2).detach().numpy()
    shift, turn, stretch = np.split(BSpline(knots, curves, 3)(t), [3, 7], axis=1)
    for k in range(3):
        quats = torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64)
        point, one = torch.randn(1, 3, dtype=torch.float64), torch.ones(1, 1, dtype=torch.float64)
        step = layer(SkinningInputs(point, quats, one, torch.tensor([[k]])), time(t))
        rotation, pivot = as_rotation(torch.from_numpy(turn[k])), layer.pivots[k].numpy()
        longer = np.eye(3) + stretch[k][[[0, 3, 4], [3, 1, 5], [4, 5, 2]]]
        expected = rotation.apply(longer @ (point[0].numpy() - pivot)) + pivot + shift[k]
        assert np.abs((point + step.delta_means).detach().numpy()[0] - expected).max() <= EXACT
        assert (as_rotation((quats + step.delta_quats)[0]) * rotation.inv()).magnitude() <= EXACT
        lengths = np.linalg.norm(rotation.as_matrix() @ longer, axis=0)
        assert np.abs(step.delta_scales.exp().detach().numpy()[0] - lengths).max() <= EXACT
        assert (step.weight == 1).all()


def test_scales_grow_along_a_gaussians_own_axes() -> None:
    layer, half = BasisLayer(1, 4).double(), 0.5**0.5
    with torch.no_grad():
        layer.stretches[:, 0, 0] = 1.0  # twice as long along x
    quats = torch.tensor([[half, 0.0, 0.0, half]], dtype=torch.float64)  # its second axis is -x
    zeros, ones = (torch.full((1, 3), value, dtype=torch.float64) for value in (0, 1))
    step = layer(SkinningInputs(zeros, quats, ones[:, :1], torch.tensor([[0]])), time(0.5))
    assert np.abs(step.delta_scales.exp().detach().numpy() - [[1, 2, 1]]).max() <= EXACT


def test_a_gaussian_follows_the_mean_of_its_motions() -> None:
    layer, carried = layer_of(), carried_of(7, 3)
    moved = carried.means + layer(carried, time(0.3)).delta_means
    alone = [layer(carried._replace(skinning_weights=torch.eye(3).double()[[k] * 7]), time(0.3)) for k in range(3)]
    mean = sum(carried.skinning_weights[:, k, None] * (carried.means + alone[k].delta_means) for k in range(3))
    assert float((moved - mean).abs().max().detach()) <= EXACT


def test_a_new_layer_moves_nothing() -> None:
    step = BasisLayer(3, 4).double()(carried_of(5, 3), time(0.7))
    assert float(step.delta_means.abs().max().detach()) <= EXACT
    assert float(step.delta_quats.abs().max().detach()) <= EXACT
    assert float(step.delta_scales.abs().max().detach()) <= EXACT


def plainly(carried: SkinningInputs, motions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """What the kernels do, by matrices."""
    blended = torch.einsum("nk,nkm->nm", carried.skinning_weights, motions[carried.node_ids])
    matrices, offsets, turns = blended[:, :9].view(-1, 3, 3), blended[:, 9:12], blended[:, 12:]
    moved = torch.einsum("nij,nj->ni", matrices, carried.means) + offsets
    lengths = (matrices @ rotation_matrices(carried.quats)).norm(dim=1)
    turned = product(turns / turns.norm(dim=1, keepdim=True), carried.quats)
    return moved - carried.means, lengths.clamp_min(LEAST_STRETCH).log(), turned - carried.quats


def test_kernels_do_what_matrices_do() -> None:
    layer, carried = layer_of(6), carried_of(9, 6)
    with torch.no_grad():
        layer.stretches[:, 2, :3] = -1.2  # squeezed to nothing and a bit beyond
        carried.skinning_weights[0] = (carried.node_ids[0] == 2).double()
    want = plainly(carried, layer.motions(time(0.3)))
    step = layer(carried, time(0.3))
    for got, expected in zip((step.delta_means, step.delta_scales, step.delta_quats), want, strict=True):
        assert float((got - expected).abs().max().detach()) <= EXACT


def test_gradients() -> None:
    layer, carried = layer_of(5), carried_of(4, 5)
    curves = dict(layer.named_parameters())
    learning = [tensor.detach().requires_grad_() for tensor in (*carried[:3], *curves.values())]

    def moved(means: torch.Tensor, quats: torch.Tensor, weights: torch.Tensor, *values: torch.Tensor) -> Any:
        replaced = dict(zip(curves, values, strict=True))
        of_now = SkinningInputs(means, quats, weights, carried.node_ids)
        return torch.func.functional_call(layer, replaced, (of_now, time(0.41)))[:3]

    assert torch.autograd.gradcheck(moved, learning)


def test_quaternions_as_scipy_has_them() -> None:
    a, b = (carried_of(6, 3).quats.roll(k, dims=0) for k in (0, 1))
    assert ((as_rotation(product(a, b)) * (as_rotation(a) * as_rotation(b)).inv()).magnitude() <= EXACT).all()
    assert np.abs(rotation_matrices(a).numpy() - as_rotation(a).as_matrix()).max() <= EXACT
    assert float(cubic_weights(time(0.37)).sum()) == pytest.approx(1)


def test_pivots_are_spread_among_what_is_opaque() -> None:
    generator = torch.Generator().manual_seed(3)
    means = torch.rand(400, 3, generator=generator)
    opacities = torch.where(means[:, 0] < 0.5, 0.9, 0.01)
    layer = BasisLayer(20, 4)
    logits, ids = layer.place(means, opacities)
    assert bool((layer.pivots[:, 0] < 0.5).all())
    assert len(layer.pivots.unique(dim=0)) == 20
    nearest = torch.cdist(means, layer.pivots).topk(K_NEAREST, largest=False).indices
    assert torch.equal(ids.sort(dim=1).values, nearest.sort(dim=1).values)
    assert torch.equal(ids.gather(1, logits.argmax(dim=1, keepdim=True)), nearest[:, :1])


@pytest.mark.parametrize("count", [1, 3])
def test_fewer_gaussians_than_motions(count: int) -> None:
    layer = BasisLayer(12, 4)
    logits, ids = layer.place(torch.rand(count, 3), torch.full((count,), 0.1))
    assert bool(torch.isfinite(logits).all())
    assert ids.shape == (count, K_NEAREST)


def test_beyond_the_window_motions_stay_and_turn_on() -> None:
    layer = BasisLayer(1, 40)
    angles = 0.1 * torch.arange(43)
    with torch.no_grad():
        layer.shifts[:, 0, 0] = torch.arange(43.0)
        layer.turns[:, 0] = torch.stack([(angles / 2).cos(), 0 * angles, 0 * angles, (angles / 2).sin()], dim=1)
    known = layer.turns.detach().clone()
    layer.on_window(0.1, 0.2)
    inside = [k for k in range(43) if abs((k - 1) / 40 - 0.5) <= 0.2 + 0.5 / 40]
    assert torch.equal(layer.shifts[inside, 0, 0].detach(), torch.tensor(inside, dtype=torch.float32))
    assert (layer.shifts[: inside[0], 0, 0] == inside[0]).all()
    assert (layer.shifts[inside[-1] :, 0, 0] == inside[-1]).all()
    near = slice(inside[0] - 3, inside[-1] + 4)
    assert float((layer.turns.detach()[near] - known[near]).abs().max()) <= tolerance("float32.relative")


def test_a_body_that_moves_as_one_has_no_strain() -> None:
    layer = BasisLayer(6, 4).double()
    with torch.no_grad():
        means = torch.rand(6, 3, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
        layer.place(means, torch.ones(6))
        turn = torch.tensor([0.8, 0.6, 0.0, 0.0], dtype=torch.float64)
        layer.turns[:] = turn
        turned = torch.from_numpy(as_rotation(turn).apply(layer.pivots.numpy()))
        layer.shifts[:] = turned - layer.pivots + torch.tensor([1.0, 2.0, 3.0])
        assert float(layer.strains(time(0.4))) <= EXACT
        layer.shifts[:, 2, 0] += 0.5
        distances = torch.cdist(layer.pivots, layer.pivots)
        near = distances.topk(5, largest=False).indices[:, 1:]
        touched = (near == 2) | (torch.arange(6)[:, None] == 2)
        expected = torch.where(touched, 0.5 / (distances.gather(1, near) + 0.01), 0.0).mean()
        assert float(layer.strains(time(0.4))) == pytest.approx(float(expected))


def test_straight_motion_does_not_bend() -> None:
    layer = BasisLayer(2, 6).double()
    with torch.no_grad():
        layer.shifts[:] = torch.arange(9.0)[:, None, None]
        assert float(layer.bends(time(0.5))) <= EXACT
        layer.shifts[5, 0, 1] += 0.6
        assert float(layer.bends(time(0.5))) == pytest.approx((0.6 + 1.2) / (2 * 2 * 3))
        assert float(layer.bends(time(0.1))) <= EXACT


def test_only_the_first_layer_may_be_of_bases() -> None:
    with pytest.raises(InvalidInput, match="layers"):
        ModelConfig(layers=("mlp", "bases"))


def test_rigid_motions_stay_rigid() -> None:
    model = random_model(20, layers=("bases",), num_nodes=4, num_knots=3, affine=False, embedding_dim=0)
    bases = model.double().bases
    assert bases is not None
    assert not any("stretches" in name for name, _ in bases.named_parameters())
    turns = bases.motions(time(0.3))[:, :9].view(-1, 3, 3).detach()
    assert float((turns @ turns.transpose(1, 2) - torch.eye(3)).abs().max()) <= EXACT


def test_stretches_are_factors_of_scales() -> None:
    with pytest.raises(InvalidInput, match="delta_space"):
        ModelConfig(layers=("bases",), delta_space="activated")


def test_of_a_model_the_means_get_gradients_as_they_are_turned() -> None:
    model = random_model(20, layers=("bases",), num_nodes=4, num_knots=3, embedding_dim=0).double()
    weights = torch.randn(20, 3, dtype=torch.float64)
    (got,) = torch.autograd.grad((model.pose(0.3).means * weights).sum(), [model.gaussians.means])
    nudged = torch.zeros(20, 3, dtype=torch.float64)
    for axis in range(3):
        for sign in (1, -1):
            with torch.no_grad():
                model.gaussians.means[:, axis] += sign * 1e-5
                nudged[:, axis] += sign * (model.pose(0.3).means * weights).sum(dim=1) / 2e-5
                model.gaussians.means[:, axis] -= sign * 1e-5
    assert float((got - nudged).abs().max()) <= tolerance("motion_gradient")

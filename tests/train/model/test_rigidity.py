"""What the rigidity loss asks for: nothing of a rigid motion, the more the further distances are stretched."""

import pytest
import torch
from torch import Tensor

from msdgs_train.density.gradient import rotate
from msdgs_train.losses.rigidity import stretch


def cloud(n: int = 200, scale: float = 1.0) -> Tensor:
    return scale * torch.randn(n, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)


def loss(before: Tensor, after: Tensor, scene_half_size: float = 1.0) -> Tensor:
    return stretch(before, after, scene_half_size, torch.Generator().manual_seed(0))


def turned(points: Tensor) -> Tensor:
    quats = torch.nn.functional.normalize(torch.tensor([[0.3, 0.5, -0.7, 0.2]], dtype=points.dtype), dim=1)
    return rotate(quats.expand(len(points), 4), points) + torch.tensor([0.4, -2.0, 1.0], dtype=points.dtype)


@pytest.mark.parametrize("n", [0, 1])
def test_a_lonely_gaussian_costs_nothing(n: int) -> None:
    assert loss(cloud(n), 3 + cloud(n)) == 0


def test_a_rigid_motion_costs_nothing() -> None:
    assert loss(cloud(), turned(cloud())) < 1e-12


@pytest.mark.parametrize("factor", [0.5, 1.1, 3.0])
def test_a_stretch_costs_its_share_of_the_distances(factor: float) -> None:
    cost = float(loss(cloud(), factor * cloud()))
    assert 0.9 * abs(factor - 1) < cost < abs(factor - 1)


def test_the_cost_does_not_depend_on_the_unit_of_length() -> None:
    metres = loss(cloud(), 1.3 * cloud(), scene_half_size=1.0)
    millimetres = loss(cloud(scale=1e3), 1.3 * cloud(scale=1e3), scene_half_size=1e3)
    torch.testing.assert_close(metres, millimetres)


def test_the_gradient_brings_a_stray_point_back() -> None:
    before, after = cloud(), cloud()
    after[7] += 0.5
    after.requires_grad_(True)
    loss(before, after).backward()
    assert after.grad is not None
    assert (after.grad[7] * 0.5).sum() > 0


def test_points_in_one_place_have_a_finite_gradient() -> None:
    after = torch.zeros(10, 3, requires_grad=True)
    loss(torch.ones(10, 3), after).backward()
    assert after.grad is not None
    assert torch.isfinite(after.grad).all()

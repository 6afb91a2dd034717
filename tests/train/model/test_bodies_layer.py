"""Bodies: what nodes do that follow them, where they are placed, and what doesn't depend on their size."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from msdgs_train.layers.base import PAPER_HEADS, SceneBounds
from msdgs_train.layers.bodies import BodiesConfig, BodiesLayer
from msdgs_train.layers.placement import spread_centers
from tests.support.reference_deformation import plain_step
from tests.support.tolerances import assert_close, tolerance

EXACT = tolerance("rotation")
CONFIG = BodiesConfig(num_knots=5, num_bodies=3)


def normal(seed: int, *shape: int) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def layer_of(points: torch.Tensor, config: BodiesConfig = CONFIG, noise: float = 0.3) -> BodiesLayer:
    """In float64, placed among points."""
    layer = BodiesLayer(config, len(points), (2.0, 4.5)).double()
    layer.on_deform_start(points)
    with torch.no_grad():
        for seed, parameter in enumerate(layer.parameters()):
            parameter.add_(noise * normal(seed, *parameter.shape))
    return layer


def time(t: float) -> torch.Tensor:
    return torch.tensor(t, dtype=torch.float64)


@pytest.mark.parametrize("t", [2.0, 2.013, 3.1, 4.5, 1.0, 7.0])
def test_nodes_move_as_a_plain_reading_says(t: float) -> None:
    nodes = normal(9, 8, 3)
    layer = layer_of(nodes)
    got, want = layer(nodes + 0.1, time(t)), plain_step(layer, nodes.numpy() + 0.1, t)
    assert_close(got.delta_means.detach(), want.means, "rotation")
    assert_close(got.delta_quats.detach(), want.quats, "rotation")
    assert not got.delta_scales.any()
    assert torch.equal(got.weight, torch.ones(8, 1, dtype=torch.float64))
    assert np.abs(want.means).max() > 0.1


def test_gradients() -> None:
    nodes = normal(9, 4, 3).requires_grad_()
    layer = layer_of(nodes.detach())
    assert torch.autograd.gradcheck(lambda x, *_: tuple(layer(x, time(3.1))[:3:2]), (nodes, *layer.parameters()))


def test_nodes_of_one_body_move_rigidly() -> None:
    nodes = torch.cat([normal(1, 6, 3), normal(2, 6, 3) + 10])
    layer = layer_of(nodes, replace(CONFIG, num_bodies=2), noise=0.0)
    with torch.no_grad():
        layer.logits.mul_(100)  # of a softmax of 0 and 1
        layer.transls[:, 1], layer.rots[:, 1] = normal(3, 3), normal(4, 4)
    moved = nodes + layer(nodes, time(3.3)).delta_means.detach()
    still, turned = (slice(0, 6), slice(6, 12)) if layer.centers[1, 0] > 5 else (slice(6, 12), slice(0, 6))
    assert float((moved[still] - nodes[still]).abs().max()) <= EXACT
    assert float((torch.pdist(moved[turned]) - torch.pdist(nodes[turned])).abs().max()) <= EXACT
    assert float((moved[turned] - nodes[turned]).norm(dim=1).min()) > 0.1


def test_bodies_at_rest_move_nothing_at_all() -> None:
    nodes = normal(9, 20, 3).float()
    layer = BodiesLayer(CONFIG, 20, (0.0, 1.0))
    layer.on_deform_start(nodes)
    step = layer(nodes, torch.tensor(0.37))
    assert not step.delta_means.any()
    assert not step.delta_quats.any()


@pytest.mark.parametrize("factor", [1e-2, 30.0])
def test_changes_of_poses_have_the_same_effect_in_scenes_of_any_size(factor: float) -> None:
    nodes, shifts, found = normal(9, 20, 3), normal(8, 20, 3), []
    for places in (nodes, factor * nodes):
        layer = layer_of(places, noise=0.0)
        assert (layer.rots.norm(dim=2) == layer.sizes).all()
        moved = (layer(places, time(3.1)).delta_means * shifts).sum()
        found.append([*torch.autograd.grad(moved, (layer.transls, layer.rots)), layer.weights().detach()])
    for got, want in zip(*found, strict=True):
        assert_close(got, want.numpy(), "rotation")
    assert bool(found[0][1].any())


def test_bodies_are_as_large_as_the_nodes_near_them_are_far() -> None:
    spread = torch.tensor([1.0, 2.0])
    nodes = torch.cat([size * normal(k, 50, 3) + 40 * k for k, size in enumerate(spread)])
    layer = layer_of(nodes, replace(CONFIG, num_bodies=2), noise=0.0)
    order = layer.centers[:, 0].argsort()
    distances = [(nodes[part] - nodes[part].mean(dim=0)).norm(dim=1).mean() for part in (slice(50), slice(50, None))]
    assert_close(layer.sizes[order], 2 * torch.stack(distances).numpy(), "rotation")


def test_centers_are_the_means_of_the_nearest() -> None:
    points = torch.cat([normal(k, 5 + k, 3) + 40 * k for k in range(4)])
    centers = spread_centers(points, 4)
    groups = torch.cdist(points, centers).argmin(dim=1)
    assert sorted(groups.bincount().tolist()) == [5, 6, 7, 8]
    for k in range(4):
        assert_close(centers[k], points[groups == k].mean(dim=0).numpy(), "rotation")


@pytest.mark.parametrize("count", [1, 2, 5])
def test_there_are_no_more_bodies_than_nodes(count: int) -> None:
    layer = BodiesConfig(num_bodies=4).build(SceneBounds(), PAPER_HEADS, count)
    layer.on_deform_start(torch.ones(count, 3))  # all at one place
    assert layer.logits.shape == (count, min(count, 4))
    assert all(bool(value.isfinite().all()) for value in layer.state_dict().values())
    assert not layer(torch.ones(count, 3), torch.tensor(0.5)).delta_means.any()


def test_steady_motion_is_smooth_and_others_cost() -> None:
    layer = BodiesLayer(replace(CONFIG, num_bodies=2, body_smoothness_weight=0.5), 4, (0.0, 1.0)).double()
    with torch.no_grad():
        layer.transls[:] = torch.arange(8.0)[:, None, None]
        generator = torch.Generator()
        assert float(layer.regularizers(normal(0, 4, 3), time(0.4), generator)["body_smoothness"]) <= EXACT
        layer.transls[3, 0, 1] += 0.6  # second differences of 0.6 and -1.2 among 2 of 2 bodies in 3 axes
        rough = layer.regularizers(normal(0, 4, 3), time(0.35), generator)["body_smoothness"]
    assert float(rough) == pytest.approx(0.5 * (0.6 + 1.2) / (2 * 2 * 3))


def test_operations_are_counted() -> None:
    layer = BodiesLayer(CONFIG, 7, (0.0, 1.0))
    assert layer.operations() == 2 * (3 * 16 + 9)

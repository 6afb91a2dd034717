"""Density control: who is cloned, split and pruned, and that Adam's moments follow their Gaussians."""

import math
from typing import Any

import pytest
import torch

from msdgs_train.density.gradient import SPLIT_SHRINK, GradientStrategy, rotate
from msdgs_train.engine.config import TrainConfig
from msdgs_train.engine.optimizer import make_optimizer
from msdgs_train.gaussians.model import DynamicGaussians
from tests.support.training_scene import small_config

EXTENT = 4.0


def _setup(count: int = 6, **changes: Any) -> tuple[DynamicGaussians, torch.optim.Adam, GradientStrategy]:
    """Gaussians of scale 0.001 (to be cloned) and moments that tell the rows apart."""
    from msdgs_train.gaussians.canonical import CanonicalGaussians

    config: TrainConfig = small_config(init_num_pts=count, max_gaussians=100, grow_grad2d=0.5, **changes)
    gaussians = CanonicalGaussians.random_in_cube(count, 1.0, 1, config.model.embedding_dim, 0)
    with torch.no_grad():
        gaussians.log_scales.fill_(math.log(0.001))
    model = DynamicGaussians(config.model, gaussians)
    optimizer = make_optimizer(model, config)
    for p in model.parameters():
        p.grad = torch.zeros_like(p)
    optimizer.step()
    for p in gaussians.parameters():
        rows = torch.arange(1, count + 1, dtype=torch.float32).reshape(-1, *[1] * (p.ndim - 1))
        optimizer.state[p]["exp_avg"] += rows
        optimizer.state[p]["exp_avg_sq"] += 10 * rows
    return model, optimizer, GradientStrategy.start(config, EXTENT, count)


def _gather(control: GradientStrategy, pixels: list[float]) -> None:
    """A gradient for each, in NDC units at 2 × 2 pixels."""
    grads = torch.tensor(pixels)
    control.accumulate(torch.stack([grads, torch.zeros_like(grads)], dim=1), torch.ones(len(pixels)), 2, 2)


def _moment_rows(model: DynamicGaussians, optimizer: torch.optim.Adam, name: str) -> list[float]:
    state = optimizer.state[getattr(model.gaussians, name)]
    first, second = (state[m].reshape(len(model.gaussians), -1)[:, 0] for m in ("exp_avg", "exp_avg_sq"))
    assert torch.equal(second, 10 * first)
    return first.tolist()


def test_gradients_are_scaled_to_ndc_and_averaged_over_where_drawn() -> None:
    _, _, control = _setup(2)
    grads = torch.tensor([[0.3, 0.4], [1.0, 1.0]])
    control.accumulate(grads, torch.tensor([1.0, 0.0]), 20, 20)
    control.accumulate(grads, torch.tensor([1.0, 0.0]), 20, 20)
    assert torch.allclose(control.gradients, torch.tensor([10.0, 0.0]))
    assert control.counts.tolist() == [2.0, 0.0]


def test_small_ones_are_cloned_as_they_are() -> None:
    model, optimizer, control = _setup()
    before = {name: p.detach().clone() for name, p in model.gaussians.named_parameters()}
    _gather(control, [0, 1, 0, 0, 0.6, 0.4])
    assert control.densify(model.gaussians, optimizer, 4) == (2, 0, 0)
    for name, p in model.gaussians.named_parameters():
        assert torch.equal(p, before[name][[0, 1, 2, 3, 4, 5, 1, 4]]), name
        if p.numel():
            assert _moment_rows(model, optimizer, name) == [1, 2, 3, 4, 5, 6, 0, 0]


def test_large_ones_are_split_inside_themselves() -> None:
    model, optimizer, control = _setup()
    with torch.no_grad():
        model.gaussians.log_scales[2] = torch.tensor([0.2, 1e-6, 1e-6]).log()
        model.gaussians.raw_quats[2] = torch.tensor([2.0, 0, 0, 2.0])  # 90° around z, not unit: x becomes y
    old = model.gaussians.means[2].detach().clone()
    _gather(control, [0, 0, 1, 0, 0, 0])
    assert control.densify(model.gaussians, optimizer, 4) == (0, 1, 0)
    assert len(model.gaussians) == 7
    halves = model.gaussians.means[5:].detach() - old
    assert (halves[:, 1].abs() > 1e-3).all()
    assert (halves[:, [0, 2]].abs() < 1e-4).all()
    assert torch.allclose(model.gaussians.log_scales[5:, 0].exp(), torch.tensor(0.2 / SPLIT_SHRINK))
    assert _moment_rows(model, optimizer, "means") == [1, 2, 4, 5, 6, 0, 0]


def test_faint_ones_go_at_once_and_giants_after_the_first_reset() -> None:
    model, optimizer, control = _setup(reset_every=9)
    with torch.no_grad():
        model.gaussians.raw_opacities[0] = -10.0
        model.gaussians.log_scales[1] = math.log(0.2 * EXTENT)
    assert control.densify(model.gaussians, optimizer, 8).pruned == 1
    assert control.densify(model.gaussians, optimizer, 12).pruned == 1
    assert _moment_rows(model, optimizer, "means") == [3, 4, 5, 6]


def test_a_scene_that_has_faded_is_left_alone() -> None:
    model, optimizer, control = _setup()
    with torch.no_grad():
        model.gaussians.raw_opacities.fill_(-10.0)
    assert control.densify(model.gaussians, optimizer, 4).pruned == 0
    assert len(model.gaussians) == 6


def test_strongest_gradients_come_first_under_the_cap() -> None:
    model, optimizer, control = _setup()
    control.config = small_config(init_num_pts=6, max_gaussians=8, grow_grad2d=0.5, static_fraction=0.0)
    _gather(control, [0.6, 0.9, 0.7, 0.8, 0.6, 0.6])
    assert control.densify(model.gaussians, optimizer, 4).cloned == 2
    assert torch.equal(model.gaussians.means[6:], model.gaussians.means[[1, 3]])
    _gather(control, [1.0] * 8)
    assert control.densify(model.gaussians, optimizer, 8) == (0, 0, 0)


def test_opacities_are_cut_and_their_moments_forgotten() -> None:
    model, optimizer, control = _setup()
    with torch.no_grad():
        model.gaussians.raw_opacities[0] = -6.0
    control.reset_opacities(model.gaussians, optimizer)
    opacities = model.gaussians.raw_opacities.detach().sigmoid()
    assert float(opacities[0]) == pytest.approx(1 / (1 + math.exp(6)), rel=1e-5)
    assert torch.allclose(opacities[1:], torch.tensor(0.01))
    assert _moment_rows(model, optimizer, "raw_opacities") == [0] * 6
    assert _moment_rows(model, optimizer, "means") == [1, 2, 3, 4, 5, 6]


def test_the_next_step_moves_old_and_new_rows() -> None:
    model, optimizer, control = _setup()
    _gather(control, [1.0] * 6)
    control.densify(model.gaussians, optimizer, 4)
    before = model.gaussians.means.detach().clone()
    optimizer.zero_grad()
    (model.gaussians.means.sum() + model.gaussians.raw_opacities.sum()).backward()
    optimizer.step()
    assert (model.gaussians.means != before).all()


def test_splits_depend_on_the_seed_alone() -> None:
    results = []
    for noise in (1, 2):
        torch.manual_seed(noise)
        model, optimizer, control = _setup()
        with torch.no_grad():
            model.gaussians.log_scales.fill_(math.log(0.2))
        _gather(control, [1.0] * 6)
        control.densify(model.gaussians, optimizer, 4)
        results.append(model.gaussians.means.detach())
    assert torch.equal(*results)


def test_schedule() -> None:
    config = small_config(steps=100, refine_start=10, refine_every=10, refine_stop_fraction=0.5, reset_every=20)
    control = GradientStrategy.start(config, EXTENT, 1)
    assert [s for s in range(1, 101) if config.refines_at(s)] == [10, 20, 30, 40, 50]
    assert [s for s in range(1, 101) if control.is_reset_due(s)] == [20, 40]
    off = GradientStrategy.start(small_config(refine_every=0, reset_every=0), EXTENT, 1)
    assert not any(off.config.refines_at(s) or off.is_reset_due(s) for s in range(1, 101))


def test_rotation() -> None:
    half = math.sqrt(0.5)
    turned = rotate(torch.tensor([[half, 0, 0, half]]), torch.tensor([[1.0, 2.0, 3.0]]))
    assert torch.allclose(turned, torch.tensor([[-2.0, 1.0, 3.0]]), atol=1e-6)

"""MCMC density control: formulas against slow ones; the budget and the image are kept."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from msdgs_train.datasets import load_scene
from msdgs_train.density.mcmc import MAX_COPIES, MCMCStrategy, compute_relocation
from msdgs_train.engine.schedule import Schedule
from msdgs_train.engine.trainer import Trainer
from msdgs_train.gaussians.canonical import CanonicalGaussians
from msdgs_train.gaussians.surgery import RowSurgery
from tests.support.tolerances import assert_close
from tests.support.training_scene import moment_rows, small_config, with_moments

OPACITIES = (0.005, 0.1, 0.5, 0.9, 0.999)
SHARES = (1, 2, 3, 7, 20, 51)


def slow_share(opacity: float, shares: int) -> tuple[float, float]:
    """Equation 9 of the paper as gsplat's kernel has it, two nested sums."""
    new = 1 - (1 - opacity) ** (1 / shares)
    total = 0.0
    for i in range(1, shares + 1):
        for k in range(i):
            total += math.comb(i - 1, k) * (-1) ** k / math.sqrt(k + 1) * new ** (k + 1)
    return new, opacity / total


def shared(opacity: float, shares: int) -> tuple[float, float]:
    new, shrink = compute_relocation(torch.tensor([opacity], dtype=torch.float64), torch.tensor([shares]))
    return float(new), float(shrink)


@pytest.mark.parametrize("opacity", OPACITIES)
@pytest.mark.parametrize("shares", SHARES)
def test_copies_follow_the_formula_and_together_look_like_one(opacity: float, shares: int) -> None:
    """Opacity at the centre, and alpha summed along a line through it, by quadrature."""
    new, shrink = shared(opacity, shares)
    assert_close((new, shrink), slow_share(opacity, shares), "share.relative")
    assert 1 - (1 - new) ** shares == pytest.approx(opacity)
    x = np.linspace(-12, 12, 4001)
    one = opacity * np.exp(-(x**2) / 2)
    together = 1 - (1 - new * np.exp(-((x / shrink) ** 2) / 2)) ** shares
    assert_close(np.trapezoid(together, x), np.trapezoid(one, x), "share.relative")


def test_more_copies_than_the_maximum_count_as_the_maximum() -> None:
    assert shared(0.7, 1000) == shared(0.7, MAX_COPIES)


def test_an_opaque_gaussian_can_be_copied() -> None:
    for new, shrink in (shared(1.0, shares) for shares in SHARES):
        assert 0 < new < 1
        assert 0 < shrink <= 1


def setup(count: int = 100, **changes: Any) -> tuple[CanonicalGaussians, RowSurgery, MCMCStrategy]:
    """Gaussians of random opacity, the first ten of them of a low one."""
    values: dict[str, Any] = {"density_strategy": "mcmc", "init_num_pts": count, "max_gaussians": 1000}
    schedule = Schedule.from_config(small_config(**(values | changes)))
    gaussians = CanonicalGaussians.random_in_cube(count, 1.0, 1, 0, schedule.config.model.attributes())
    with torch.no_grad():
        gaussians.raw_opacities[:] = torch.randn(count, generator=torch.Generator().manual_seed(1))
        gaussians.raw_opacities[:10] = -9.0
    return gaussians, with_moments(gaussians, schedule), MCMCStrategy.start(schedule, schedule.config.density.bound(0))


def test_low_opacity_gaussians_are_relocated_to_others() -> None:
    gaussians, surgery, control = setup()
    before = {name: p.detach().clone() for name, p in gaussians.named_parameters()}
    assert control.relocate(surgery) == (10, 5)
    assert len(gaussians) == 105
    places = {tuple(mean.tolist()): i for i, mean in enumerate(before["means"])}
    origins = torch.tensor([places[tuple(mean.tolist())] for mean in gaussians.means.detach()])
    assert origins.min() == 10, "no low-opacity Gaussian is left"
    assert origins[:90].tolist() == list(range(10, 100))
    counts = torch.bincount(origins, minlength=100)
    for row, origin in enumerate(origins.tolist()):
        opacity, shrink = slow_share(before["raw_opacities"][origin].double().sigmoid().item(), int(counts[origin]))
        assert_close(gaussians.raw_opacities[row].sigmoid().item(), max(opacity, 0.005), "float32.relative")
        wanted = (before["log_scales"][origin].double() + math.log(shrink)).exp()
        assert_close(gaussians.log_scales[row].detach().exp(), wanted, "shared_scale.relative")
    for name in ("raw_quats", "sh_dc", "sh_rest", "embeddings"):
        assert torch.equal(gaussians.get_parameter(name), before[name][origins]), name
    moments = [0 if counts[origin] > 1 else origin + 1 for origin in origins.tolist()]
    for name, p in gaussians.named_parameters():
        if p.numel():
            assert moment_rows(surgery, name) == moments


def test_opaque_ones_are_drawn_more_often() -> None:
    gaussians, surgery, control = setup(1000, max_gaussians=5000)
    with torch.no_grad():
        gaussians.raw_opacities[:900] = math.log(0.01 / 0.99)
        gaussians.raw_opacities[900:] = math.log(0.9 / 0.1)
    means = gaussians.means.detach()[900:].clone()
    control.relocate(surgery)
    added = gaussians.means.detach()[1000:]
    assert len(added) == 50
    near_opaque = sum(bool((means == mean).all(dim=1).any()) for mean in added)
    assert near_opaque > 40  # 0.91 of them are expected to be


@pytest.mark.parametrize(("budget", "rounds"), [(100, 3), (103, 3), (117, 10)])
def test_never_more_than_the_budget_and_all_of_it_in_the_end(budget: int, rounds: int) -> None:
    gaussians, surgery, control = setup(max_gaussians=budget)
    counts = []
    for _ in range(rounds):
        control.relocate(surgery)
        counts.append(len(gaussians))
    assert counts == sorted(counts)
    assert max(counts) <= budget
    assert counts[-1] == budget


def test_a_transparent_scene_is_not_changed() -> None:
    gaussians, surgery, control = setup()
    with torch.no_grad():
        gaussians.raw_opacities.fill_(-9.0)
    assert control.relocate(surgery) == (0, 0)
    assert len(gaussians) == 100


def test_noise_is_for_low_opacity_and_along_the_shape() -> None:
    gaussians, _, control = setup(refine_every_fraction=0.0)
    half = math.sqrt(0.5)
    with torch.no_grad():
        gaussians.log_scales[:] = torch.tensor([0.3, 1e-4, 1e-4]).log()
        gaussians.raw_quats[:] = torch.tensor([3 * half, 0.0, 0.0, 3 * half])  # x becomes y
    before = gaussians.means.detach().clone()
    control.inject_noise(gaussians, 1e-5)
    moved = (gaussians.means.detach() - before).abs()
    assert moved[:10, 1].min() > 1e-4
    assert moved[:10, [0, 2]].max() < 1e-6
    opaque = gaussians.raw_opacities.sigmoid() > 0.3
    assert moved[opaque].max() < 1e-9


def test_noise_has_the_size_of_the_formula() -> None:
    gaussians, _, control = setup(4000, max_gaussians=4000)
    with torch.no_grad():
        gaussians.raw_opacities.fill_(math.log(0.005 / 0.995))
        gaussians.log_scales.fill_(math.log(0.2))
    before = gaussians.means.detach().clone()
    control.inject_noise(gaussians, 2e-6)
    std = (gaussians.means.detach() - before).std()
    assert float(std) == pytest.approx(0.5 * 2e-6 * 5e5 * 0.2**2, rel=0.05)


def test_training_keeps_to_the_budget_at_every_step(data: Path) -> None:
    config = small_config(
        steps=40, density_strategy="mcmc", max_gaussians=67, refine_start_fraction=0.05, refine_every_fraction=0.05
    )
    trainer = Trainer(config, load_scene(data))
    results = [trainer.step() for _ in range(40)]
    counts = [result.gaussians for result in results]
    assert counts[0] == config.density.init_num_pts
    assert max(counts) == counts[-1] == 67
    assert results[-1].skipped == 0

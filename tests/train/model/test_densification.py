"""Density control: cloning, splitting and pruning, and Adam's moments of the Gaussians."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from msdgs_serve.scene import Camera
from msdgs_serve.scene.camera import look_at
from msdgs_train.datasets import load_scene
from msdgs_train.density.config import DensityConfig
from msdgs_train.density.gradient import MIN_PATIENCE, SPLIT_SHRINK, GradientStrategy
from msdgs_train.engine.schedule import Schedule
from msdgs_train.gaussians.canonical import CanonicalGaussians
from msdgs_train.gaussians.surgery import RowSurgery
from msdgs_train.rendering.info import RasterizationInfo
from tests.support.tolerances import tolerance
from tests.support.training_scene import moment_rows, small_config, splatting, trained, with_moments

EXTENT = 4.0


def _setup(count: int = 6, **changes: Any) -> tuple[CanonicalGaussians, RowSurgery, GradientStrategy]:
    """Gaussians of scale 0.001 (to be cloned)."""
    schedule = _schedule(init_num_pts=count, **changes)
    gaussians = CanonicalGaussians.random_in_cube(count, 1.0, 1, 0, schedule.config.model.attributes())
    with torch.no_grad():
        gaussians.log_scales.fill_(math.log(0.001))
    most, cameras = schedule.config.density.bound(0), [camera_at(distance) for distance in (4.0, 8.0)]
    control = GradientStrategy.start(schedule, most, EXTENT, count, cameras, False)
    return gaussians, with_moments(gaussians, schedule), control


def camera_at(distance: float) -> Camera:
    """A camera that looks at the origin, with pixels of a hundredth of the distance."""
    return Camera(
        100.0, 100.0, 40.0, 30.0, 80, 60, look_at(np.array([0, 0, -distance]), np.zeros(3), np.array([0, -1.0, 0]))
    )


def _schedule(**changes: Any) -> Schedule:
    return Schedule.from_config(small_config(**{"max_gaussians": 100, "grow_grad2d": 0.5} | changes))


def _accumulate(control: GradientStrategy, pixels: list[float]) -> None:
    """A gradient for each, in NDC units at 2 × 2 pixels."""
    grads = torch.tensor(pixels)
    control.accumulate(_screen(torch.stack([grads, torch.zeros_like(grads)], dim=1)), 2, 2, False)


def _screen(grads: torch.Tensor, radii: list[float] | None = None) -> RasterizationInfo:
    """One image of the Gaussians, drawn with a radius of one pixel unless stated."""
    info = RasterizationInfo()
    info.radii = torch.tensor(radii or [1.0] * len(grads))
    info.means2d_grads = grads
    return info


def test_gradients_are_scaled_to_ndc_and_averaged_over_where_drawn() -> None:
    _, _, control = _setup(2)
    grads = torch.tensor([[0.3, 0.4], [1.0, 1.0]])
    control.accumulate(_screen(grads, [1.0, 0.0]), 20, 20, False)
    control.accumulate(_screen(grads, [1.0, 0.0]), 20, 20, False)
    assert torch.allclose(control.gradients, torch.tensor([10.0, 0.0]))
    assert control.counts.tolist() == [2.0, 0.0]


def test_absolute_gradients_are_accumulated_if_asked_for(data: Path) -> None:
    """And the step is the same."""
    signed, absolute = (
        trained(small_config(absolute_gradients=wanted), load_scene(data), 1) for wanted in (False, True)
    )
    control = [splatting(trainer).density for trainer in (signed, absolute)]
    assert all(isinstance(each, GradientStrategy) for each in control)
    (small, counts, _), (large, same_counts, _) = (each.state() for each in control)
    assert torch.equal(counts, same_counts)
    assert bool((large >= small * (1 - tolerance("float32.relative"))).all())
    assert float(large.sum()) > 1.2 * float(small.sum())
    for one, other in zip(signed.system.model.parameters(), absolute.system.model.parameters(), strict=True):
        assert torch.equal(one, other)


def test_small_ones_are_cloned_as_they_are() -> None:
    gaussians, surgery, control = _setup()
    before = {name: p.detach().clone() for name, p in gaussians.named_parameters()}
    _accumulate(control, [0, 1, 0, 0, 0.6, 0.4])
    assert control.densify(surgery, 4) == (2, 0, 0)
    for name, p in gaussians.named_parameters():
        assert torch.equal(p, before[name][[0, 1, 2, 3, 4, 5, 1, 4]]), name
        if p.numel():
            assert moment_rows(surgery, name) == [1, 2, 3, 4, 5, 6, 0, 0]


def test_large_ones_are_split_inside_themselves() -> None:
    gaussians, surgery, control = _setup()
    with torch.no_grad():
        gaussians.log_scales[2] = torch.tensor([0.2, 1e-6, 1e-6]).log()
        gaussians.raw_quats[2] = torch.tensor([2.0, 0, 0, 2.0])  # 90° around z, not unit: x becomes y
    old = gaussians.means[2].detach().clone()
    _accumulate(control, [0, 0, 1, 0, 0, 0])
    assert control.densify(surgery, 4) == (0, 1, 0)
    assert len(gaussians) == 7
    halves = gaussians.means[5:].detach() - old
    assert (halves[:, 1].abs() > 1e-3).all()
    assert (halves[:, [0, 2]].abs() < 1e-4).all()
    assert torch.allclose(gaussians.log_scales[5:, 0].exp(), torch.tensor(0.2 / SPLIT_SHRINK))
    assert moment_rows(surgery, "means") == [1, 2, 4, 5, 6, 0, 0]


def test_low_opacity_gaussians_are_pruned_at_once_and_huge_ones_after_a_reset() -> None:
    gaussians, surgery, control = _setup(reset_every_fraction=9 / 24)
    with torch.no_grad():
        gaussians.raw_opacities[0] = -10.0
        gaussians.log_scales[1] = math.log(0.2 * EXTENT)
    assert control.densify(surgery, 8).pruned == 1
    assert control.densify(surgery, 12).pruned == 1
    assert moment_rows(surgery, "means") == [3, 4, 5, 6]


@pytest.mark.parametrize(("size", "split"), [(0.15, True), (0.17, False)])
def test_huge_ones_are_split_before_they_are_removed(size: float, split: bool) -> None:
    """A size, as a fraction of the scene's scale, counts after its split: 0.15 / 1.6 is below 0.1."""
    gaussians, surgery, control = _setup(reset_every_fraction=9 / 24)
    with torch.no_grad():
        gaussians.log_scales[1] = math.log(size * EXTENT)
    _accumulate(control, [0, 1, 0, 0, 0, 0])
    assert control.densify(surgery, 12) == (0, int(split), int(not split))
    assert moment_rows(surgery, "means") == [1, 3, 4, 5, 6, *([0, 0] if split else [])]


def test_the_cap_holds_where_all_are_hidden_or_huge() -> None:
    gaussians, surgery, control = _setup(reset_every_fraction=9 / 24, max_gaussians=7)
    with torch.no_grad():
        gaussians.raw_opacities[:3] = -10.0
        gaussians.log_scales[3:] = math.log(0.2 * EXTENT)
    _accumulate(control, [1.0] * 6)
    assert control.densify(surgery, 12) == (0, 3, 3)
    assert len(gaussians) == 6


def test_gaussians_that_no_image_shows_are_removed() -> None:
    """Of six, four are seen, one has no gradient and one isn't drawn."""
    gaussians, surgery, control = _setup(prune_unseen_passes=1.5, window_full_fraction=0.0, refine_every_fraction=0.0)
    grads = torch.tensor([[1e-6, 0.0]] * 4 + [[0.0, 0.0]] * 2)
    screen = _screen(grads, [2.0] * 5 + [0.0])
    for _ in range(round(1.5 * MIN_PATIENCE)):
        control.accumulate(screen, 2, 2, False)
        control.after_step(surgery, range(1, 2))
    assert control.densify(surgery, 4).pruned == 0
    control.accumulate(screen, 2, 2, False)
    assert control.densify(surgery, 4).pruned == 2
    control.accumulate(_screen(grads[:4], [1.0, 1.0, 0.0, 1.0]), 2, 2, True)
    control.accumulate(_screen(grads[:4]), 2, 2, True)
    assert control.densify(surgery, 4).pruned == 1, "one that was outside of an image that shows everything"
    assert len(gaussians) == 3


def test_gaussians_far_smaller_than_a_pixel_are_removed() -> None:
    """At the origin the nearer camera has pixels of 0.04."""
    gaussians, surgery, control = _setup(prune_subpixel=0.1)
    with torch.no_grad():
        gaussians.means[:] = 0.0
        gaussians.log_scales[:, 0] = torch.tensor([0.003, 0.0039, 0.0041, 0.01, 0.1, 0.2]).log()
    assert control.densify(surgery, 4).pruned == 2
    assert len(gaussians) == 4


def test_a_growing_window_may_hide_gaussians() -> None:
    for is_rig, pruned in ((False, 0), (True, 6)):
        _, surgery, control = _setup(prune_unseen_passes=1.5, window_full_fraction=0.9, refine_every_fraction=0.0)
        control.is_rig = is_rig
        for _ in range(2 * MIN_PATIENCE):
            control.accumulate(_screen(torch.zeros(6, 2)), 2, 2, False)
            control.after_step(surgery, range(12, 13))
        assert int(control._hidden(surgery.gaussians, torch.ones(6)).sum()) == 0
        assert int((control.unseen > control.patience).sum()) == pruned


def test_a_transparent_scene_is_not_changed() -> None:
    gaussians, surgery, control = _setup()
    with torch.no_grad():
        gaussians.raw_opacities.fill_(-10.0)
    assert control.densify(surgery, 4).pruned == 0
    assert len(gaussians) == 6


def test_strongest_gradients_come_first_under_the_cap() -> None:
    gaussians, surgery, control = _setup(max_gaussians=8, static_fraction=0.0)
    _accumulate(control, [0.6, 0.9, 0.7, 0.8, 0.6, 0.6])
    assert control.densify(surgery, 4).cloned == 2
    assert torch.equal(gaussians.means[6:], gaussians.means[[1, 3]])
    _accumulate(control, [1.0] * 8)
    assert control.densify(surgery, 8) == (0, 0, 0)


@pytest.mark.parametrize(
    ("pixels", "bound"), [(100, 18_000), (200 * 200, 18_000), (400 * 400, 72_000), (1920 * 1080, 100_000)]
)
def test_the_cap_follows_the_size_of_the_images_unless_it_is_given(pixels: int, bound: int) -> None:
    assert DensityConfig(max_gaussians=None).bound(pixels) == bound
    assert DensityConfig(max_gaussians=9_000).bound(pixels) == 9_000
    assert DensityConfig(init_num_pts=200_000, max_gaussians=None).bound(pixels) == 200_000


def test_opacities_are_reset_and_so_are_their_moments() -> None:
    gaussians, surgery, control = _setup()
    with torch.no_grad():
        gaussians.raw_opacities[0] = -6.0
    control.reset_opacities(surgery)
    opacities = gaussians.raw_opacities.detach().sigmoid()
    assert float(opacities[0]) == pytest.approx(1 / (1 + math.exp(6)), rel=1e-5)
    assert torch.allclose(opacities[1:], torch.tensor(0.01))
    assert moment_rows(surgery, "raw_opacities") == [0] * 6
    assert moment_rows(surgery, "means") == [1, 2, 3, 4, 5, 6]


def test_the_next_step_moves_old_and_new_rows() -> None:
    gaussians, surgery, control = _setup()
    _accumulate(control, [1.0] * 6)
    control.densify(surgery, 4)
    before = gaussians.means.detach().clone()
    surgery.optimizer.zero_grad()
    (gaussians.means.sum() + gaussians.raw_opacities.sum()).backward()
    surgery.optimizer.step()
    assert (gaussians.means != before).all()


def test_splits_depend_on_the_seed_alone() -> None:
    results = []
    for noise in (1, 2):
        torch.manual_seed(noise)
        gaussians, surgery, control = _setup()
        with torch.no_grad():
            gaussians.log_scales.fill_(math.log(0.2))
        _accumulate(control, [1.0] * 6)
        control.densify(surgery, 4)
        results.append(gaussians.means.detach())
    assert torch.equal(*results)


def test_schedule() -> None:
    refines = {"refine_start_fraction": 0.1, "refine_every_fraction": 0.1, "refine_stop_fraction": 0.5}
    on = _schedule(steps=100, reset_every_fraction=0.2, **refines)
    assert [s for s in range(1, 101) if on.refines_at(s)] == [10, 20, 30, 40, 50]
    assert [s for s in range(1, 101) if on.resets_at(s)] == [20, 40]
    off = _schedule(refine_every_fraction=0.0, reset_every_fraction=0.0)
    assert not any(off.refines_at(s) or off.resets_at(s) for s in range(1, 101))

"""The plane layer against a slow float64 version, and its gradients against finite differences."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from msdgs_train.layers.base import SceneBounds
from msdgs_train.layers.plane import PlaneConfig, PlaneGrid, PlaneLayer
from tests.support.reference_deformation import plain_features

SIZES = PlaneConfig(features=5, resolution=6, time_resolution=7, width=8, multires=(1,))


def layer(config: PlaneConfig = SIZES, dtype: torch.dtype = torch.float64) -> PlaneLayer:
    torch.manual_seed(0)
    made = PlaneLayer(config, SceneBounds(1.3))
    with torch.no_grad():
        for parameter in made.parameters():
            parameter.add_(0.3 * torch.randn_like(parameter))
    return made.to(dtype)


def places(n: int = 40) -> Tensor:
    """Inside, outside, and on the nodes at both ends."""
    means = 1.6 * (2 * torch.rand(n, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64) - 1)
    means[0], means[1] = 1.3, -1.3
    return means


@pytest.mark.parametrize("multires", [(1,), (1, 2), (2, 1, 3)])
@pytest.mark.parametrize("t", [0.0, 0.37, 0.5, 1.0, -0.2, 1.7])
def test_features_are_products_of_interpolated_planes(t: float, multires: tuple[int, ...]) -> None:
    planes, seen = layer(replace(SIZES, multires=multires)), {}
    planes.features.register_forward_pre_hook(lambda _, inputs: seen.update(features=inputs[0]))
    planes(places(), torch.tensor(t, dtype=torch.float64))
    slow = np.concatenate([plain_features(grid, places().numpy(), t) for grid in planes.plane_grids()], axis=1)
    assert [grid.space.shape[1] for grid in planes.plane_grids()] == [6 * factor for factor in multires]
    np.testing.assert_allclose(seen["features"].detach().numpy(), slow, rtol=1e-12)


def test_the_whole_time_range_is_used() -> None:
    planes = PlaneGrid(16, 32, 5, 1.0, (2.0, 6.0))
    with torch.no_grad():
        planes.time[:] = torch.arange(5.0)[None, :, None, None]
    for t, expected in [(2.0, 0.0), (3.5, 1.5), (6.0, 4.0), (9.0, 4.0)]:
        torch.testing.assert_close(planes.lines(torch.tensor(t)), torch.full((3, 32, 16), expected))


def test_a_mean_that_is_no_number_is_read_inside_the_grid() -> None:
    planes, means = layer(), places(3)
    means[1] = torch.nan
    assert torch.isfinite(torch.cat(planes(means, torch.tensor(0.4, dtype=torch.float64))[:4], dim=1)[[0, 2]]).all()


@pytest.mark.slow
def test_gradients_match_finite_differences() -> None:
    planes = layer(PlaneConfig(features=3, resolution=3, time_resolution=4, width=4, multires=(1, 2)))
    means = places(6).requires_grad_(True)
    t = torch.tensor(0.43, dtype=torch.float64)

    def run(means: Tensor, *parameters: Tensor) -> Tensor:
        named = dict(zip(dict(planes.named_parameters()), parameters, strict=True))
        step = torch.func.functional_call(planes, named, (means, t))
        return torch.cat(step[:4], dim=1)

    means = means.detach()[2:].clamp(-1.2, 1.2).requires_grad_(True)  # the derivative is discontinuous at the border
    assert torch.autograd.gradcheck(run, (means, *planes.parameters()), eps=1e-6, atol=1e-7)


def test_a_place_outside_has_no_slope() -> None:
    planes = layer()
    means = torch.tensor([[2.0, 0.1, 0.1]], dtype=torch.float64, requires_grad=True)
    torch.cat(planes(means, torch.tensor(0.5, dtype=torch.float64))[:4], dim=1).sum().backward()
    assert means.grad is not None
    assert means.grad[0, 0] == 0
    assert means.grad[0, 1] != 0


def test_the_same_bits_whatever_the_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    def gradients(threads: str) -> list[Tensor]:
        monkeypatch.setenv("MSDGS_THREADS", threads)
        planes = layer(dtype=torch.float32)
        torch.cat(planes(places(500).float(), torch.tensor(0.3))[:4], dim=1).square().sum().backward()
        return [p.grad for p in planes.grids.parameters() if p.grad is not None]

    for one, several in zip(gradients("1"), gradients("3"), strict=True):
        assert torch.equal(one, several)


def test_time_nodes_that_enter_the_window_extrapolate_its_border() -> None:
    planes = PlaneGrid(16, 32, 11, 1.0, (0.0, 1.0))
    with torch.no_grad():
        planes.time[:] = torch.arange(11.0)[None, :, None, None]
    planes.on_window(0.12, 0.31)
    # before: times 0.38 to 0.62 read nodes 3 to 7; after: 0.19 to 0.81, nodes 1 to 9
    assert planes.time[0, :, 0, 0].tolist() == [0, 3, 3, 3, 4, 5, 6, 7, 7, 7, 10]


def test_flat_grids_and_straight_lines_in_time_are_smooth() -> None:
    planes = PlaneGrid(16, 32, 9, 1.0, (0.0, 1.0))
    with torch.no_grad():
        planes.space[:] = 0.3
        planes.time[:] = torch.linspace(1, 5, 9)[None, :, None, None]
        assert float(planes.time_smoothness() + planes.plane_tv() + planes.plane_smoothness()) < 1e-12
        assert float(planes.l1_time_planes()) == pytest.approx(2)
        planes.time[:, 4] += 1
        planes.space[:, 3] += 1
        assert float(planes.time_smoothness()) == pytest.approx((1 + 4 + 1) / 7)
        assert float(planes.l1_time_planes()) == pytest.approx(2 + 1 / 9)
        assert float(planes.plane_tv()) == pytest.approx(2 / 31)
        assert float(planes.plane_smoothness()) == pytest.approx((1 + 4 + 1) / 30)


def test_two_nodes_have_no_second_difference() -> None:
    planes = PlaneGrid(4, 2, 2, 1.0, (0.0, 1.0))
    with torch.no_grad():
        assert float(planes.time_smoothness()) == float(planes.plane_smoothness()) == 0

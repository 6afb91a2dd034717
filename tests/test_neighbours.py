"""Nearest neighbours against all pairs."""

import pytest
import torch
from torch import Tensor

from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.neighbours import nearest


def cloud(n: int) -> Tensor:
    return torch.randn(n, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)


@pytest.mark.parametrize(("n", "count"), [(50, 6), (4, 6), (2, 3)])
def test_nearest_are_those_of_all_pairs(n: int, count: int) -> None:
    points = cloud(n)
    distances, indices = nearest(points, count)
    pairs = torch.cdist(points, points).fill_diagonal_(torch.inf)
    expected = pairs.topk(min(count, n - 1), largest=False)
    torch.testing.assert_close(distances, expected.values)
    assert torch.equal(indices, expected.indices)


@pytest.mark.parametrize("n", [0, 1])
def test_nothing_is_near_a_lonely_point(n: int) -> None:
    distances, indices = nearest(cloud(n), 6)
    assert distances.shape == indices.shape == (n, 0)


def test_points_in_one_place_are_each_others_neighbours() -> None:
    distances, indices = nearest(torch.ones(20, 3), 3)
    assert torch.equal(distances, torch.zeros(20, 3))
    assert (indices != torch.arange(20)[:, None]).all()


def test_a_point_that_is_not_finite_is_refused() -> None:
    points = cloud(5)
    points[2, 1] = torch.nan
    with pytest.raises(InvalidInput, match="`points` must be finite, got 1 of 5"):
        nearest(points, 3)

"""Distances to nearest neighbours where all pairs are no guide; `test_model.py` compares with those."""

import pytest
import torch

from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.gaussians.canonical import neighbor_distances


@pytest.mark.parametrize("n", [0, 1])
def test_nothing_is_near_a_lonely_point(n: int) -> None:
    assert torch.equal(neighbor_distances(torch.rand(n, 3)), torch.ones(n))


def test_points_in_one_place_are_each_others_neighbours() -> None:
    assert torch.equal(neighbor_distances(torch.ones(20, 3)), torch.zeros(20))


def test_a_point_that_is_not_finite_is_refused() -> None:
    points = torch.rand(5, 3)
    points[2, 1] = torch.nan
    with pytest.raises(InvalidInput, match="`points` must be finite, got 1 of 5"):
        neighbor_distances(points)

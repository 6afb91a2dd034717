"""Nearest rows beside loops in float64, and farthest points."""

import numpy as np
import pytest
import torch

from msdgs_train.layers.placement import farthest_points
from msdgs_train.supports.nearest import nearest, nearest_by_sorting


def plain_nearest(points: np.ndarray, centers: np.ndarray, count: int) -> list[list[int]]:
    found = []
    for point in points.astype(np.float64):
        squares = [float(((point - center) ** 2).sum()) for center in centers.astype(np.float64)]
        found.append(sorted(range(len(centers)), key=lambda m: (squares[m], m))[:count])
    return found


@pytest.mark.parametrize(
    ("rows", "centers", "dimensions", "count"), [(70, 33, 11, 3), (5, 2, 3, 8), (1, 9, 1, 9), (0, 4, 3, 2)]
)
def test_nearest_rows_are_those_of_plain_loops(rows: int, centers: int, dimensions: int, count: int):
    draw = np.random.default_rng(rows).normal
    # whole numbers, whose sums of squares are exact: many are equally near, and the first of them counts
    points, others = (np.round(2 * draw(size=(n, dimensions))).astype(np.float32) for n in (rows, centers))
    expected = np.array(plain_nearest(points, others, count), np.int64).reshape(rows, min(count, centers))
    assert torch.equal(nearest(torch.from_numpy(points), torch.from_numpy(others), count), torch.from_numpy(expected))


def test_sorting_finds_the_same_rows(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("msdgs_train.supports.nearest.CHUNK", 7)
    points, centers = (torch.randn(n, 11, generator=torch.Generator().manual_seed(n)) for n in (40, 21))
    assert torch.equal(nearest_by_sorting(points, centers, 3), nearest(points, centers, 3))
    assert nearest_by_sorting(points[:0], centers, 3).shape == (0, 3)


def test_each_farthest_point_is_the_farthest_from_those_before():
    points = torch.randn(40, 6, generator=torch.Generator().manual_seed(0))
    chosen, distances = farthest_points(points, 9, 4)
    assert chosen[0] == 4
    assert len(set(chosen.tolist())) == 9
    apart = (points[:, None] - points[chosen]).norm(dim=2)
    for k in range(1, 9):
        assert int(apart[:, :k].amin(dim=1).argmax()) == chosen[k]
    torch.testing.assert_close(distances, apart.amin(dim=1))

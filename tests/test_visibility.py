"""Until when photographs show what follows a motion."""

from pathlib import Path

import numpy as np
import pytest
import torch

from msdgs_serve.scene import Camera
from msdgs_serve.scene.camera import orbit
from msdgs_train import visibility
from msdgs_train.datasets import Frame
from msdgs_train.gaussians import CanonicalGaussians
from msdgs_train.model import Domain, DynamicGaussians
from msdgs_train.model_config import ModelConfig
from msdgs_train.visibility import seen_until

KNOTS = 20
WALL, BALL, CORK = range(3)


def frames(count: int = 41, time_range: tuple[float, float] = (0.0, 1.0)) -> list[Frame]:
    pose = orbit(np.zeros(3), 4.0, 0.0, 0.0, np.array([0.0, 0.0, 1.0]))
    camera = Camera.from_fov(pose, 24, 24, 40.0)
    times = np.linspace(*time_range, count)
    return [Frame(str(t), camera, float(t), Path("never read")) for t in times]


def scene(hidden_from: float, time_range: tuple[float, float] = (0.0, 1.0)) -> DynamicGaussians:
    """A wall, a ball that goes behind it at a part of the time and stays, and a cork that never does."""
    towards = torch.tensor(orbit(np.zeros(3), 1.0, 0.0, 0.0, np.array([0.0, 0.0, 1.0]))[:3, 3], dtype=torch.float32)
    up = torch.tensor([0.0, 0.0, 1.0])
    means = torch.stack([torch.zeros(3), 0.7 * towards, 0.7 * towards + 0.5 * up])
    gaussians = CanonicalGaussians(
        means,
        torch.tensor([[0.5], [0.1], [0.1]]).log().expand(3, 3).clone(),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(3, 1),
        torch.full((3,), 8.0),
        torch.ones(3, 1, 3),
        torch.zeros(3, 0, 3),
        basis_logits=torch.full((3, 3), -30.0).fill_diagonal_(0.0),
        basis_ids=torch.tensor([[WALL, BALL, CORK]] * 3),
    )
    config = ModelConfig(sh_degree=0, layers=("bases",), basis_count=3, basis_knots=KNOTS, embedding_size=0)
    model = DynamicGaussians(config, gaussians, Domain(1.3, time_range))
    assert model.bases is not None
    with torch.no_grad():
        for k in range(KNOTS + 3):
            if (k - 1) / KNOTS > hidden_from:
                model.bases.shifts[k, BALL] = -1.4 * towards
    return model


@pytest.mark.parametrize("time_range", [(0.0, 1.0), (2.0, 6.0)])
def test_what_goes_behind_a_wall_is_seen_until_then(time_range: tuple[float, float]) -> None:
    seen = seen_until(scene(0.75, time_range), frames(time_range=time_range), time_range)
    assert seen.shape == (2, 3)
    assert (seen[0] == 0.5).all()
    assert seen[1, WALL] == seen[1, CORK] == 0.5
    assert 0.15 <= seen[1, BALL] <= 0.3


def test_what_is_hidden_at_the_last_moment_alone_is_not_lost() -> None:
    assert (seen_until(scene(0.97), frames(), (0.0, 1.0)) == 0.5).all()


def test_what_is_hidden_from_before_the_middle_on_is_known_there_alone() -> None:
    assert seen_until(scene(0.3), frames(), (0.0, 1.0))[1, BALL] == 0


def test_of_many_photographs_some_are_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    looked, draw = [], visibility.rasterize
    monkeypatch.setattr(visibility, "MOST_FRAMES", 10)
    monkeypatch.setattr(visibility, "rasterize", lambda *args: looked.append(args) or draw(*args))
    seen = seen_until(scene(0.75), frames(41), (0.0, 1.0))
    assert len(looked) == 9
    assert 0.0 <= seen[1, BALL] <= 0.3


def test_one_photograph() -> None:
    assert (seen_until(scene(0.75), frames(1), (0.0, 0.0)) == 0.5).all()

"""Sampling for fitted plans: as dense as the motion needs; too fast motion is detected."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import BSpline

from msdgs_export.bake import Baked, bake
from msdgs_export.plans.registry import build
from msdgs_export.trajectories import sampling as module
from msdgs_export.trajectories.poses import ExactPoses
from msdgs_export.trajectories.sampling import Trajectories
from msdgs_export.trajectories.splines import design, fitting, samples_for
from msdgs_serve.deformation import DeformationSession
from tests.support.models import SCENE, random_model
from tests.support.tolerances import assert_close, tolerance

pytestmark = pytest.mark.slow

COUNT = 40
Motion = Callable[[float], np.ndarray]


class Made(ExactPoses):
    """Poses by formula: `motion(t)` is added to the means, [40, 3]."""

    def __init__(self, baked: Baked, motion: Motion) -> None:
        super().__init__(baked)
        self._motion = motion

    def at(self, t: float, ids: np.ndarray | None = None) -> np.ndarray:
        every = np.tile([0.0, 0, 0, 0.1, 0.2, 0.3, 1, 0, 0, 0], (COUNT, 1))
        every[:, :3] += self._motion(t)
        return every if ids is None else every[ids]


@pytest.fixture
def sampled(monkeypatch: pytest.MonkeyPatch) -> Callable[[Motion], tuple[Baked, Trajectories]]:
    baked = bake(random_model(COUNT), SCENE, "0" * 64)

    def sample(motion: Motion) -> tuple[Baked, Trajectories]:
        monkeypatch.setattr(module, "ExactPoses", lambda baked: Made(baked, motion))
        return baked, Trajectories(baked)

    return sample


def of_first(motion: Callable[[float], float], others: float = 0.0) -> Motion:
    """The first Gaussian moves along x; the others by the fraction `others` of that."""
    return lambda t: np.array([[motion(t) * (1 if i == 0 else others), 0, 0] for i in range(COUNT)])


FAST = {
    "between all coarse samples, on none": lambda t: np.sin(2 * np.pi * 64 * t),
    "a jump back and forth": lambda t: float(np.exp(-(((t - 0.505) / 0.004) ** 2))),
    "fast from the start": lambda t: np.sin(2 * np.pi * 40 * t),
    "between all times of comparison, on none": lambda t: np.sin(2 * np.pi * 128 * t),
}


@pytest.mark.parametrize("name", FAST)
def test_a_fast_motion_that_a_coarse_sampling_misses_is_followed(sampled, tmp_path: Path, name: str):
    baked, trajectories = sampled(of_first(FAST[name]))
    (tmp_path / "scene.onnx").write_bytes(build("compact:70", baked, trajectories).SerializeToString())
    session = DeformationSession(tmp_path / "scene.onnx")
    off = max(abs(session.pose(t, [0])[0][0, 0] - FAST[name](t)) for t in np.linspace(0, 1, 401))
    assert off < tolerance("fast_motion")


def test_unresolved_motion_is_counted(sampled):
    _, trajectories = sampled(of_first(lambda t: np.sin(2 * np.pi * 9000 * t)))
    assert list(trajectories.unresolved) == [0]


def test_a_rotation_past_half_a_turn_has_one_sign_along_time():
    samples = np.zeros((1, 9, 10), np.float32)
    angles = np.linspace(0, 2 * np.pi, 9)
    quats = np.stack([np.cos(angles), np.sin(angles), 0 * angles, 0 * angles], axis=1)
    samples[0, :, 6:] = quats * np.where(np.arange(9) % 2, -1, 1)[:, None]
    module.give_one_sign(samples)
    assert_close(samples[0, :, 6:], quats.astype(np.float32), "encoding.float32")


@pytest.mark.parametrize("count", [4, 5, 12, 67])
def test_splines_fit_what_they_can_hold_and_keep_both_ends(count: int):
    times = samples_for(count)
    assert_close(fitting(count, times) @ design(count, times), np.eye(count), "spline_fit")
    samples = np.random.default_rng(0).standard_normal((times, 3))
    shown = design(count, times) @ (fitting(count, times) @ samples)
    assert_close(shown[[0, -1]], samples[[0, -1]], "spline_fit")
    knots = np.concatenate([np.zeros(3), np.linspace(0, 1, count - 2), np.ones(3)])
    assert_close(design(count, 9), BSpline(knots, np.eye(count), 3)(np.linspace(0, 1, 9)), "spline_fit")

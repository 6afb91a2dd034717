"""Levels of detail of trajectories against slow and obvious computations in float64."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from msdgs_export.bake import bake
from msdgs_export.measure.poses import posed
from msdgs_export.measure.views import cameras_of
from msdgs_export.plans import compact
from msdgs_export.plans.compact import chosen
from msdgs_export.plans.registry import build
from msdgs_export.pruning.mask import bake_pruned, full_mask, pruned
from msdgs_export.trajectories import sensitivity
from msdgs_export.trajectories.levels import OWN, PEAKS, RANKS, Levels, sizes
from msdgs_export.trajectories.sampling import Trajectories
from msdgs_export.trajectories.sensitivity import sensitivities
from msdgs_export.trajectories.splines import design
from msdgs_export.trajectories.stored import StoredPoses
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.rasterizer import rasterize
from msdgs_serve.scene.gaussians import Gaussians
from msdgs_train.gaussians.model import DynamicGaussians
from tests.support.models import MLP, SCENE, random_model
from tests.support.tolerances import assert_close, tolerance

COUNT = 30
INVISIBLE = 1e-10
"""Squared errors below this, -100 dB, are those of float32."""


def made_model() -> DynamicGaussians:
    return random_model(COUNT, layers=(replace(MLP, time_frequencies=2),), noise=0.02)


@pytest.fixture(scope="module")
def trajectories() -> Trajectories:
    return Trajectories(bake(made_model(), SCENE, "0" * 64))


@pytest.fixture(scope="module")
def levels(trajectories: Trajectories) -> Levels:
    return Levels(trajectories)


def test_sensitivities_are_squared_differences_of_frames(monkeypatch: pytest.MonkeyPatch, trajectories: Trajectories):
    monkeypatch.setattr(sensitivity, "PASSES", 2000)
    (_, camera), *_ = cameras_of(SCENE)
    scene, samples = trajectories.scene, np.repeat(trajectories.on_grid(65, np.arange(COUNT))[:, :1], 2, axis=1)
    found = sensitivities(scene, samples, [camera])

    def frame(poses: np.ndarray) -> np.ndarray:
        g = Gaussians(
            poses[:, :3], poses[:, 6:], poses[:, 3:6], *(a.astype(float) for a in (scene.opacities, scene.sh))
        )
        return rasterize(g, camera, background=scene.metadata.background).rgb

    poses, step = samples[:, 0].astype(np.float64), 1e-5
    base = frame(poses)
    most = np.einsum("mcc->m", found).argsort()[-3:]
    for i, column in itertools.product(most, range(10)):
        direction = np.eye(10)[column]
        if column >= 6:  # tangent to unit quaternions
            direction[6:] -= poses[i, column] * poses[i, 6:]
        moved = poses.copy()
        moved[i] += step * direction
        want = np.square((frame(moved) - base) / step).mean()
        assert direction @ found[i] @ direction == pytest.approx(want, rel=tolerance("hutchinson.relative"))
    radial = np.einsum("mc,mcd,md->m", poses[:, 6:], found[:, 6:, 6:], poses[:, 6:])
    assert np.abs(radial).max() <= tolerance("float32.relative") * np.abs(found).max()


def test_errors_of_levels_are_those_of_poses_rebuilt_from_what_is_stored(trajectories: Trajectories, levels: Levels):
    ids = np.arange(COUNT)
    samples = trajectories.on_grid(1025, ids).astype(np.float64)
    roots = trajectories.roots.astype(np.float64)

    def error(control: np.ndarray) -> np.ndarray:
        got = np.einsum("tn,mnc->mtc", design(control.shape[1], 1025), control) + levels.means[:, None]
        squares = np.square(np.einsum("mtc,mcd->mtd", got - samples, roots)).sum(axis=2)
        return (squares**PEAKS).mean(axis=1) ** (1 / PEAKS)

    for level, rank in enumerate(rank for rank in RANKS if rank <= COUNT):
        control = np.einsum("mr,nrc->mnc", levels.coefficients[:, :rank], levels.functions[:, :rank].astype(float))
        assert_close(levels.errors[level], error(control), "visible_error.relative")
    assert (np.diff(levels.errors.sum(axis=1)) < 0).all()
    for level in (0, 1, 2, len(OWN) - 2):
        count, bits = OWN[level]
        want = error(StoredPoses.of(levels.own(ids, count), bits).control().astype(float))
        got = levels.own_errors(ids, level)
        assert_close(np.maximum(got, INVISIBLE), np.maximum(want, INVISIBLE), "visible_error.relative")


@pytest.mark.parametrize("sampled", [COUNT, 7])
def test_the_choice_keeps_the_error_and_minimizes_a_lagrangian_of_errors_and_bytes(
    monkeypatch: pytest.MonkeyPatch, levels: Levels, sampled: int
):
    monkeypatch.setattr(compact, "SAMPLED", sampled)
    rows, rates = np.arange(COUNT), sizes(levels.num_ranks)
    every = np.concatenate([levels.errors, [levels.own_errors(rows, level) for level in range(len(OWN))]])
    totals = []
    for db in (30, 45, 60):
        choice = chosen(levels, rows, 10 ** (-db / 10))
        assert choice.errors.sum() <= 10 ** (-db / 10)
        assert ((choice.own >= 0) == (choice.ranks < 0)).all()
        picked = np.where(choice.own >= 0, levels.num_ranks + choice.own, np.searchsorted(RANKS, choice.ranks))
        np.testing.assert_array_equal(choice.errors, every[picked, rows])
        # some multiplier makes each Gaussian's level the best of those up to the highest rank
        stored = np.r_[: np.searchsorted(RANKS, choice.ranks.max()) + 1, levels.num_ranks : len(rates)]
        saved, added = choice.errors - every[stored], rates[stored, None] - rates[picked]
        with np.errstate(divide="ignore", invalid="ignore"):
            multipliers = saved / added
        assert np.where(added > 0, multipliers, -np.inf).max() <= np.where(added < 0, multipliers, np.inf).min()
        totals.append(rates[picked].sum())
    assert totals == sorted(totals)


def test_an_unreachable_error_gives_the_smallest(levels: Levels):
    best = chosen(levels, np.arange(COUNT), 0.0)
    assert (best.own >= 0).any()
    assert best.errors.sum() < chosen(levels, np.arange(COUNT), 1e-7).errors.sum()


def test_a_part_of_the_gaussians_takes_the_levels_of_all_and_keeps_its_order(trajectories: Trajectories):
    ids, model = np.array([3, 5, 20]), made_model()
    some = trajectories.some(ids)
    assert some.once(Levels) is trajectories.once(Levels)
    mask = full_mask(model).without(kept=np.isin(np.arange(COUNT), ids))
    baked = bake_pruned(pruned(model, mask, posed(model, 0.0, deform=False), []), SCENE, "0" * 64)
    part, whole = (
        DeformationSession("scene.onnx", contents=build("compact:90", *scene).SerializeToString())
        for scene in ((baked, some), (bake(model, SCENE, "0" * 64), trajectories))
    )
    exact = posed(model, 0.3)
    for got, want, name in zip(part.pose(0.3), whole.pose(0.3, ids), ("means", "quats", "scales"), strict=True):
        assert np.abs(got - want).max() <= tolerance("compact.pose")
        assert np.abs(got - getattr(exact, name)[ids]).max() <= tolerance("compact.pose")


@pytest.mark.parametrize("bits", [8, 16])
def test_stored_poses_are_off_by_half_a_step(bits: int):
    control = np.random.default_rng(0).standard_normal((5, 9, 10)) * np.logspace(-3, 3, 10)
    stored = StoredPoses.of(control, bits)
    assert stored.points.dtype == (np.uint8 if bits == 8 else np.int16)
    steps = np.ptp(control, axis=1) / (2**bits - 2)
    off = np.abs(stored.control() - control).max(axis=1)
    assert (off <= 0.5 * steps + tolerance("float32.relative") * np.abs(control).max(axis=1)).all()

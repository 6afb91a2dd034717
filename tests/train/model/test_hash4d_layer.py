"""The hash layer against a slow float64 version, and its gradients against finite differences."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.gaussians.config import ModelConfig
from msdgs_train.layers.base import PAPER_HEADS, Heads, SceneBounds
from msdgs_train.layers.hash4d import Hash4DConfig, Hash4DLayer
from msdgs_train.layers.hash_grid import HashGrid
from msdgs_train.layers.hash_kernels import Levels
from tests.support.models import HASH4D
from tests.support.reference_deformation import plain_hash_features, plain_step
from tests.support.tolerances import assert_close, tolerance

LEVELS = Levels.between(4, (3, 4, 2), (9, 7, 8), 100)
"""The first two levels are dense, the others are hashed; 100 rows aren't a power of two."""

BOUNDS = SceneBounds(1.3, (2.0, 4.0))


def grid(levels: Levels = LEVELS, dtype: torch.dtype = torch.float64) -> HashGrid:
    torch.manual_seed(0)
    made = HashGrid(levels, 2)
    torch.nn.init.normal_(made.table)
    return made.to(dtype)


def places(count: int = 60, columns: int = 3) -> Tensor:
    """Inside, outside, at both corners, and one that is no number."""
    drawn = torch.rand(count, columns, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    drawn = 1.1 * drawn - 0.05
    drawn[0], drawn[1], drawn[2] = 0, 1, torch.nan
    return drawn


def layer(config: Hash4DConfig = HASH4D, outputs: Heads = PAPER_HEADS) -> Hash4DLayer:
    torch.manual_seed(0)
    made = Hash4DLayer(config, BOUNDS, outputs)
    with torch.no_grad():
        for parameter in made.parameters():
            parameter.add_(0.3 * torch.randn_like(parameter))
    return made.double()


@pytest.mark.parametrize(
    ("levels", "hashed"),
    [
        (LEVELS, 2),
        (Levels.between(3, (4, 4, 4), (12, 12, 12), 128), 2),
        (Levels.between(1, (3, 3, 2), (9, 9, 9), 99), 0),
    ],
)
def test_features_are_interpolated_between_the_nodes_of_each_level(levels: Levels, hashed: int):
    made, where = grid(levels), places()
    assert levels.hashed.sum() == hashed
    slow = plain_hash_features(made, where.numpy())
    assert_close(made(where).detach(), slow, "network.float64")
    assert not slow[2].any()
    assert slow[:2].any()
    assert slow.any(axis=1).mean() > 0.5


def test_torch_computes_what_the_kernels_compute():
    made, where = grid(), places().requires_grad_(True)
    found = []
    for features in (made(where), made.in_torch(where)):
        gradients = torch.autograd.grad((features * torch.arange(8.0)).square().sum(), (made.table, where))
        found.append((features.detach(), *gradients))
    for kernels, torchs in zip(*found, strict=True):
        assert kernels.abs().max() > 0
        assert_close(torchs, kernels, "network.float64")


def test_gradients_match_finite_differences():
    made, where = grid(Levels.between(2, (2, 3, 2), (3, 4, 3), 20)), places(6)[3:].clamp(0.01, 0.99)

    def read(table: Tensor, positions: Tensor) -> Any:
        return torch.func.functional_call(made, {"table": table}, positions)

    assert torch.autograd.gradcheck(read, (made.table, where.requires_grad_(True)))


def test_the_same_bits_whatever_the_number_of_threads(monkeypatch: pytest.MonkeyPatch):
    def gradients(threads: str) -> tuple[Tensor, ...]:
        monkeypatch.setenv("MSDGS_THREADS", threads)
        made, where = grid(dtype=torch.float32), places(300).float().requires_grad_(True)
        return torch.autograd.grad(made(where).square().sum(), (made.table, where))

    for one, several in zip(gradients("1"), gradients("3"), strict=True):
        assert torch.equal(one, several)


@pytest.mark.parametrize("depth", [0, 2])
@pytest.mark.parametrize("t", [2.0, 2.7, 4.0, 4.3])
def test_the_layer_agrees_with_a_plain_reading(t: float, depth: int):
    made, means = layer(replace(HASH4D, depth=depth)), 1.7 * torch.randn(20, 3, dtype=torch.float64)
    step = made(means, torch.tensor(t, dtype=torch.float64))
    for got, want in zip(step[:4], plain_step(made, means.numpy(), t), strict=True):
        assert_close(got.detach(), want, "network.float64")


def test_the_published_network_has_its_size():
    published = Hash4DConfig()
    with torch.device("meta"):
        counts = [
            sum(p.numel() for p in Hash4DLayer(config, outputs=Heads(weight=False)).parameters())
            for config in (published, replace(published, depth=1))
        ]
    assert counts == [13_224_948, 13_290_740]
    assert Hash4DLayer(replace(HASH4D, reach=published.reach), BOUNDS).half_sizes.tolist() == [1.6000000238418579] * 3


def test_a_quaternion_of_zeros_turns_nothing():
    made, means = layer(replace(HASH4D, depth=0)), torch.randn(5, 3, dtype=torch.float64)
    with torch.no_grad():
        made.heads.weight.zero_()
        made.heads.bias.zero_()
        made.heads.bias[0] = -1
        made.heads.bias[4:7] = torch.tensor([1.0, 2.0, 3.0])
        step = made(means, torch.tensor(3.0, dtype=torch.float64))
    assert step.delta_means.tolist() == [[1.0, 2.0, 3.0]] * 5


def by_hand(made: Hash4DLayer, points: Tensor, t: Tensor) -> dict[str, float]:
    """Both terms, of all points in the order that the generator draws."""
    generator, terms = torch.Generator().manual_seed(3), {}
    where = made.places(points, t)
    for name, noise in (("spatial", [0.02] * 3), ("temporal", [0.03] * 3 + [0.004])):
        order = torch.randperm(len(points), generator=generator)
        moved = (2 * torch.rand(len(points), len(noise), generator=generator) - 1).double() * torch.tensor(noise)
        before, total = where[order][:, : len(noise)], 0.0
        for n in range(len(points)):
            pair = torch.stack([before[n], before[n] + moved[n]])
            features = made.canonical(pair) if name == "spatial" else made.temporal_features(pair)
            total += float((features[1] - features[0]).square().sum()) / len(points)
        terms[name] = total
    return terms


def test_features_that_change_where_points_are_displaced_are_regularized():
    noise = {"spatial_noise": 0.02, "temporal_noise": 0.03, "time_noise": 0.004}
    made = layer(replace(HASH4D, displaced=1.0, spatial_weight=2.0, temporal_weight=3.0, **noise))
    points, t = torch.randn(12, 3, dtype=torch.float64), torch.tensor(2.9, dtype=torch.float64)
    terms = made.regularizers(points, t, torch.Generator().manual_seed(3))
    with torch.no_grad():
        want = by_hand(made, points, t)
    assert terms["spatial"].item() == pytest.approx(2 * want["spatial"], rel=tolerance("float32.relative"))
    assert terms["temporal"].item() == pytest.approx(3 * want["temporal"], rel=tolerance("float32.relative"))
    sum(terms.values(), torch.zeros(())).backward()
    assert all(made.get_parameter(f"{name}.table").grad is not None for name in ("canonical", "temporal.0"))
    again = made.regularizers(points, t, torch.Generator().manual_seed(3))
    assert all(torch.equal(terms[name], again[name]) for name in terms)
    none = layer(replace(HASH4D, spatial_weight=0.0, temporal_weight=0.0))
    assert none.regularizers(points, t, torch.Generator()) == {}
    assert made.regularizers(points[:0], t, torch.Generator()) == {}


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("levels", 0),
        ("levels", 65),
        ("coarsest", (8, 8)),
        ("coarsest", (8, 8, 1)),
        ("finest", (32, 32, 4)),
        ("canonical_finest", (2.5, 32, 32)),
        ("log2_rows", 25),
        ("depth", -1),
        ("initialization", "xavier"),
        ("width", 1_000_000),
        ("displaced", 0.0),
        ("reach", float("inf")),
        ("time_noise", -1.0),
        ("grid_lr_init", 0.0),
        ("spatial_weight", -1.0),
    ],
)
def test_sizes_out_of_range_are_named(name: str, value: Any):
    with pytest.raises(InvalidInput, match=f"`model.layers.0.{name}` must be"):
        ModelConfig(layers=(replace(Hash4DConfig(), **{name: value}),))


def test_a_scene_of_one_time_has_a_place_in_the_grids():
    made = Hash4DLayer(HASH4D, SceneBounds(1.0, (3.0, 3.0)))
    assert torch.isfinite(made.places(torch.zeros(1, 3), torch.tensor(3.0))).all()
    assert np.isclose(float(made.places(torch.zeros(1, 3), torch.tensor(3.0))[0, 3]), 0.05)

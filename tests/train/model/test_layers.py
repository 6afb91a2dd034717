"""The deformation layers against the paper's sizes and a plain float64 implementation of its equations."""

from typing import Any

import pytest
import torch

from msdgs_train.gaussians.modulation import Modulation
from msdgs_train.layers.base import DeformationLayer, Heads
from msdgs_train.layers.bodies import BodiesConfig, BodiesLayer
from msdgs_train.layers.chain import MultiStepDeformation
from msdgs_train.layers.curves import CurveLayer
from msdgs_train.layers.hash4d import Hash4DLayer
from msdgs_train.layers.mlp import MLPConfig, MLPLayer, frequency_matrix, positional_encoding
from msdgs_train.layers.plane import PlaneLayer
from msdgs_train.layers.spline import SplineConfig, SplineLayer
from tests.support.models import HASH4D
from tests.support.reference_deformation import plain_encoding, plain_hidden, plain_step
from tests.support.tolerances import assert_close, tolerance


def parameters(module: torch.nn.Module) -> int:
    return sum(p.numel() for p in module.parameters())


def random_layer(seed: int, **sizes: Any) -> MLPLayer:
    torch.manual_seed(seed)
    defaults: dict[str, Any] = {"width": 16, "depth": 3, "time_width": 8, "time_features": 5}
    layer = MLPLayer(MLPConfig(**(defaults | sizes))).double()
    with torch.no_grad():
        for parameter in layer.parameters():
            parameter.normal_(std=0.2)
    return layer


def test_the_modulation_has_the_papers_size_starts_at_one_and_stays_bounded():
    modulation = Modulation()
    assert parameters(modulation) == 1_155
    factors = modulation(torch.randn(7, 32))
    assert torch.equal(factors["scales"], torch.ones(7, 3))
    assert list(factors) == ["scales"]
    with torch.no_grad():
        modulation.output.bias[:] = torch.tensor([200.0, -200.0, 1.0])
    scales = modulation(torch.randn(7, 32))["scales"]
    torch.testing.assert_close(scales, torch.tensor([2.0, -2.0, 1.0]).exp().expand(7, 3))


@pytest.mark.parametrize(
    "layer",
    [
        MLPLayer(MLPConfig(depth=2)),
        PlaneLayer(),
        SplineLayer(SplineConfig(num_knots=8), 9, (0.0, 1.0)),
        Hash4DLayer(HASH4D),
        BodiesLayer(BodiesConfig(num_knots=8), 9, (0.0, 1.0)),
    ],
)
def test_a_new_layer_moves_nothing_but_has_weights(layer: DeformationLayer):
    with torch.no_grad():  # in float64, as some weights are closer to each other than float32 tells
        step = layer.double()(torch.randn(9, 3).double(), torch.tensor(0.3).double())
    assert max(float(delta.abs().max()) for delta in step[:3]) <= tolerance("float32.relative")
    assert step.weight.shape == (9, 1)
    assert ((step.weight > 0) & (step.weight <= 1)).all()
    assert isinstance(layer, CurveLayer) == (step.weight.unique().numel() == 1)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("dimensions", "frequencies"), [(3, 10), (1, 6), (3, 1)])
def test_encoding_is_value_sines_cosines(dimensions: int, frequencies: int, dtype: torch.dtype):
    x = torch.rand(20_000, dimensions, dtype=dtype) * 4 - 2
    got = positional_encoding(x, frequency_matrix(dimensions, frequencies).to(dtype))
    want = plain_encoding(x.double().numpy(), frequencies)
    assert_close(got, want, f"encoding.{str(dtype).removeprefix('torch.')}")


@pytest.mark.parametrize(
    "sizes",
    [
        {},
        {"depth": 1},
        {"width": 1},
        {"xyz_frequencies": 2, "time_frequencies": 1},
        {"skip": 1},
        {"depth": 5, "skip": 3},
    ],
)
def test_layer_agrees_with_a_plain_reading(sizes: dict[str, int]):
    layer = random_layer(1, **sizes)
    means = torch.randn(20, 3, dtype=torch.float64)
    step = layer(means, torch.tensor(0.7, dtype=torch.float64))
    for got, want in zip(step[:4], plain_step(layer, means.numpy(), 0.7), strict=True):
        assert_close(got.detach(), want, "network.float64")


@pytest.mark.parametrize("initialization", ["local", "torch"])
def test_without_a_network_of_time_its_encoding_is_read(initialization: str):
    layer = MLPLayer(MLPConfig(width=16, depth=3, skip=1, time_network=False, initialization=initialization))
    t = torch.tensor(0.7)
    encoded = positional_encoding(t.reshape(1, 1), layer.time_frequency_matrix)
    assert torch.equal(layer.time_output(layer.time_hidden(encoded).relu()), encoded)
    assert layer.first.in_features == 63 + 13
    (group,) = layer.parameter_groups()
    trained = sum(p.numel() for p in group.params)
    assert trained == (63 + 13 + 1) * 16 + (63 + 13 + 16 + 1) * 16 + 17 * 16 + 17 * 11
    layer(torch.randn(5, 3), t).delta_means.sum().backward()
    assert all(p.grad is not None for p in group.params)
    assert layer.time_hidden.weight.grad is layer.time_output.weight.grad is None


def test_heads_of_opacity_and_sh_change_only_these():
    torch.manual_seed(4)
    layer = MLPLayer(MLPConfig(width=16, depth=2), Heads(opacity=True, sh=4)).double()
    assert layer.heads.out_features == 10 + 1 + 12 + 1
    with torch.no_grad():
        layer.heads.bias[10] = 0.5
        layer.heads.bias[11:23] = torch.arange(12.0)
    deltas = MultiStepDeformation([layer, layer])(torch.randn(5, 3).double(), torch.tensor(0.3).double())
    weight = layer(torch.randn(5, 3).double(), torch.tensor(0.3).double()).weight
    assert deltas.opacities is not None
    assert deltas.sh is not None
    assert deltas.sh.shape == (5, 4, 3)
    assert not any(delta.any() for delta in deltas[:3])
    assert_close((deltas.sh[:, 0, 1] / deltas.opacities).detach(), [2.0] * 5, "network.float64")
    assert ((deltas.opacities > 0) & (deltas.opacities < 1)).all()
    assert ((weight > 0) & (weight < 1)).all()


@pytest.mark.parametrize("skip", [0, 1, 2])
def test_layer_gradients(skip: int):
    sizes = {"width": 4, "depth": 3, "time_width": 3, "time_features": 2, "xyz_frequencies": 1, "time_frequencies": 1}
    layer = random_layer(2, skip=skip, **sizes)
    means = torch.randn(3, 3, dtype=torch.float64, requires_grad=True)
    t = torch.tensor(0.4, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda *x: tuple(layer(*x[:2])[:4]), (means, t, *layer.parameters()))


def last_features(layer: MLPLayer, places: torch.Tensor, t: float) -> torch.Tensor:
    return torch.from_numpy(plain_hidden(layer, places.double().numpy(), t))


@pytest.mark.parametrize(
    "sizes", [{}, {"depth": 8}, {"width": 96, "depth": 2, "time_width": 64}, {"width": 64, "depth": 3}]
)
def test_some_last_unit_is_active_everywhere(sizes: dict[str, Any]):
    places = torch.rand(500, 3, generator=torch.Generator().manual_seed(1)) * 2.6 - 1.3
    torch.manual_seed(0)
    layer = MLPLayer(MLPConfig(**sizes))
    for t in (0.0, 0.3, 1.0):
        silent = (last_features(layer, places, t) == 0).all(dim=1)
        assert silent.float().mean() < tolerance("silent_places")


def mean_cosines(layer: MLPLayer) -> tuple[float, float]:
    """Mean cosine similarity of the last features at times 0.1 apart, and at positions one unit apart."""
    places = torch.rand(300, 3, generator=torch.Generator().manual_seed(1)) * 2 - 1
    here = last_features(layer, places, 0.5)
    later = last_features(layer, places, 0.6)
    elsewhere = last_features(layer, places + torch.tensor([1.0, 0.0, 0.0]), 0.5)
    in_time, in_space = (torch.cosine_similarity(here, other).mean().item() for other in (later, elsewhere))
    return in_time, in_space


def test_a_new_layer_is_local_in_time_and_space():
    def small_layer(seed: int) -> MLPLayer:
        torch.manual_seed(seed)
        return MLPLayer(MLPConfig(width=96, depth=2, xyz_frequencies=4, time_width=64))

    ours = torch.tensor([mean_cosines(small_layer(seed)) for seed in range(8)]).mean(dim=0)
    torchs_own = []
    for seed in range(8):
        layer = small_layer(seed)
        for module in layer.modules():
            if isinstance(module, torch.nn.Linear):
                module.reset_parameters()
        torchs_own.append(mean_cosines(layer))
    assert (ours < torch.tensor([0.65, 0.5])).all(), ours
    assert (torch.tensor(torchs_own).mean(dim=0) > torch.tensor([0.95, 0.75])).all(), torchs_own

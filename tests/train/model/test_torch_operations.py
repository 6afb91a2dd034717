"""Torch's operations, which replace kernels on devices without them, against the kernels: values and gradients."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from msdgs_train.layers import arrays
from msdgs_train.layers.base import SceneBounds
from msdgs_train.layers.bodies import BodiesConfig, BodiesLayer
from msdgs_train.layers.mlp import MLPConfig, MLPLayer, frequency_matrix, positional_encoding
from msdgs_train.layers.plane import PlaneConfig, PlaneGrid, PlaneLayer
from msdgs_train.layers.precision import Precision, chosen_precision, matrix_products, trunk_precision
from msdgs_train.layers.quaternions import unit_or_identity
from msdgs_train.layers.spline import SplineConfig, SplineLayer
from msdgs_train.losses.photometric import photometric_loss
from msdgs_train.supports.skinning import skin
from tests.support.tolerances import tolerance

DTYPES = {"float64": torch.float64, "float32": torch.float32}
MASK = torch.arange(17)[:, None] + torch.arange(23) > 9
LOSSES = {"equation 13": (0.8, 0.0), "all": (0.8, 0.6), "SSIM": (0.0, 0.0), "MSE": (0.5, 1.0)}
SMALL_MLP = MLPConfig(width=24, depth=3, xyz_frequencies=10, time_width=8, time_features=5, skip=1)


@pytest.fixture
def without_kernels(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """Switches kernels off."""
    return lambda: monkeypatch.setattr(arrays, "has_kernels", lambda tensor: False)


def made(seed: int, *shape: int, dtype: torch.dtype) -> Tensor:
    return torch.randn(shape, dtype=dtype, generator=torch.Generator().manual_seed(seed))


def values_and_gradients(compute: Callable[[], Tensor], leaves: list[Tensor]) -> list[Tensor]:
    """The result, and the gradients of a fixed random sum of it."""
    result = compute()
    weights = made(9, *result.shape, dtype=result.dtype)
    return [result.detach(), *torch.autograd.grad((result * weights).sum(), leaves)]


def assert_as_kernels(
    without_kernels: Callable[[], None], name: str, compute: Callable[..., Tensor], *leaves: Tensor
) -> None:
    """Relative to the largest entry."""
    used = [leaf.requires_grad_() for leaf in leaves]
    want = values_and_gradients(lambda: compute(*used), used)
    without_kernels()
    got = values_and_gradients(lambda: compute(*used), used)
    for index, (one, other) in enumerate(zip(got, want, strict=True)):
        assert one.dtype == other.dtype
        bound = tolerance(f"torch_operations.{name}") * float(other.abs().max())
        assert float((one - other).abs().max()) <= bound, index


@pytest.mark.parametrize("name", DTYPES)
@pytest.mark.parametrize("mask", [None, MASK], ids=["all pixels", "mask"])
@pytest.mark.parametrize("weights", LOSSES.values(), ids=LOSSES)
def test_loss(
    without_kernels: Callable[[], None], name: str, mask: Tensor | None, weights: tuple[float, float]
) -> None:
    generator = torch.Generator().manual_seed(0)
    rgb, target = torch.rand(2, 17, 23, 3, dtype=DTYPES[name], generator=generator)
    rgb[3, 4] = target[3, 4]  # no error
    assert_as_kernels(without_kernels, name, lambda rgb: photometric_loss(rgb, target, *weights, mask), rgb)


@pytest.mark.parametrize("name", DTYPES)
def test_unit_quaternions(without_kernels: Callable[[], None], name: str) -> None:
    quats = made(1, 40, 4, dtype=DTYPES[name])
    quats[3], quats[7] = 0.0, torch.tensor([1e-9, 0, 0, 0])
    assert_as_kernels(without_kernels, name, unit_or_identity, quats)
    assert unit_or_identity(quats)[[3, 7]].tolist() == [[1.0, 0.0, 0.0, 0.0]] * 2


@pytest.mark.parametrize("name", DTYPES)
def test_planes(without_kernels: Callable[[], None], name: str) -> None:
    """Inside, outside and on the border of the grid; at times inside, on nodes and outside."""
    torch.manual_seed(0)
    grid = PlaneGrid(5, 9, 6, 1.3, (0.0, 1.0)).to(DTYPES[name])
    with torch.no_grad():
        grid.time.add_(0.3 * made(2, *grid.time.shape, dtype=DTYPES[name]))
    means = 1.2 * made(3, 60, 3, dtype=DTYPES[name])
    assert bool((means.abs() > 1.3).any())
    times = torch.tensor([-0.1, 0.0, 0.37, 0.4, 1.0, 1.2], dtype=DTYPES[name])

    def compute(means: Tensor, *_: Tensor) -> Tensor:
        return torch.cat([grid(means, t) for t in times])

    assert_as_kernels(without_kernels, name, compute, means, grid.space, grid.time)


@pytest.mark.parametrize("name", DTYPES)
def test_skinning(without_kernels: Callable[[], None], name: str) -> None:
    """Of rows that are no whole vectors, one of which is stretched less than the lower bound."""
    dtype = DTYPES[name]
    means, quats = made(4, 37, 3, dtype=dtype), unit_or_identity(made(5, 37, 4, dtype=dtype))
    weights = made(6, 37, 4, dtype=dtype).softmax(dim=1)
    motions = torch.cat([torch.eye(3, dtype=dtype).reshape(1, 9).repeat(6, 1), torch.zeros(6, 7, dtype=dtype)], dim=1)
    motions = motions + 0.2 * made(7, 6, 16, dtype=dtype)
    motions[:, 12] += 1
    motions[0, :9] *= 1e-3
    ids = torch.randint(6, (37, 4), generator=torch.Generator().manual_seed(8))
    ids[0] = 0

    def compute(means: Tensor, quats: Tensor, weights: Tensor, motions: Tensor) -> Tensor:
        return torch.cat(skin(means, quats, weights, ids, motions), dim=1)

    assert_as_kernels(without_kernels, name, compute, means, quats, weights, motions)


@pytest.mark.parametrize("name", DTYPES)
@pytest.mark.parametrize("kind", ["mlp", "plane", "spline", "bodies"])
def test_layers(without_kernels: Callable[[], None], name: str, kind: str) -> None:
    torch.manual_seed(0)
    layer = {
        "mlp": lambda: MLPLayer(SMALL_MLP),
        "plane": lambda: PlaneLayer(PlaneConfig(4, 6, 5, 8), SceneBounds()),
        "spline": lambda: SplineLayer(SplineConfig(num_knots=5), 30, (0.0, 1.0)),
        "bodies": lambda: BodiesLayer(BodiesConfig(num_knots=5, num_bodies=4), 30, (0.0, 1.0)),
    }[kind]().to(DTYPES[name])
    for parameter in layer.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    times = torch.tensor([0.0, 0.43, 1.0], dtype=DTYPES[name])

    def compute(means: Tensor, *_: Tensor) -> Tensor:
        steps = [layer(means, t) for t in times]
        return torch.cat([torch.cat(step[:4], dim=1) for step in steps], dim=1) + 0 * means[:, :1]

    assert_as_kernels(without_kernels, name, compute, made(3, 30, 3, dtype=DTYPES[name]), *layer.parameters())


def test_phases_of_the_encoding_are_exact(without_kernels: Callable[[], None]) -> None:
    x, frequencies = made(3, 30, 3, dtype=torch.float32), frequency_matrix(3, 10)
    by_products = positional_encoding(x, frequencies)
    without_kernels()
    assert torch.equal(positional_encoding(x, frequencies), by_products)


def outputs_of_a_trunk(precision: Precision) -> list[Tensor]:
    torch.manual_seed(0)
    layer, means = MLPLayer(SMALL_MLP), made(3, 50, 3, dtype=torch.float32).requires_grad_()
    torch.nn.init.normal_(layer.heads.weight, std=0.3)
    with trunk_precision(precision):
        step = layer(means, torch.tensor(0.3))
    return values_and_gradients(lambda: torch.cat(step[:4], dim=1), [means, *layer.parameters()])


def test_a_trunk_in_bf16_has_outputs_and_gradients_in_float32() -> None:
    """And differs from float32 by roundings."""
    want, got = outputs_of_a_trunk("float32"), outputs_of_a_trunk("bf16")
    assert not torch.equal(got[0], want[0])
    assert {tensor.dtype for tensor in got} == {torch.float32}
    narrow, wide = ([each[0], torch.cat([g.flatten() for g in each[1:]])] for each in (got, want))
    for row, one, other in zip(("bf16.values", "bf16.gradients"), narrow, wide, strict=True):
        assert float((one - other).norm()) <= tolerance(row) * float(other.norm())


def test_tf32_is_allowed_inside_alone() -> None:
    assert torch.get_float32_matmul_precision() == "highest"
    with matrix_products("tf32"):
        assert torch.get_float32_matmul_precision() == "high"
    with matrix_products("bf16"):
        assert torch.get_float32_matmul_precision() == "highest"
    with trunk_precision("tf32"):
        assert chosen_precision() == "tf32"
    assert chosen_precision() == "float32"
    assert all(map(torch.equal, outputs_of_a_trunk("tf32"), outputs_of_a_trunk("float32")))  # a CPU has no TF32
    assert torch.get_float32_matmul_precision() == "highest"

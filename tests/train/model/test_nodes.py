"""Control nodes: against a slow linear blend skinning, initialization, and local rigidity."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from msdgs_train.gaussians.model import DynamicGaussians, canonical_points
from msdgs_train.layers.base import LayerConfig
from msdgs_train.layers.chain import Deltas, MultiStepDeformation
from msdgs_train.layers.quaternions import multiply, rotation_matrices
from msdgs_train.layers.spline import SplineConfig, SplineLayer
from msdgs_train.supports.base import CanonicalPoints
from msdgs_train.supports.nodes import NodesConfig, NodesSupport
from msdgs_train.supports.skinning import skin
from msdgs_train.supports.skinning_kernels import MAX_NEAREST, MIN_STRETCH
from tests.support.models import BODIES, MLP, NODES, PLANE, SPLINE, random_model
from tests.support.reference_deformation import plain_pose, rotation
from tests.support.tolerances import assert_close, tolerance

EXACT = tolerance("rotation")
CHAINS = {
    "mlp": (MLP, MLP),
    "no weight": (MLP, MLP),
    "spline": (SPLINE,),
    "rigid": (replace(SPLINE, affine=False),),
    "plane": (PLANE,),
    "spline, plane, mlp": (SPLINE, PLANE, MLP),
    "mlp, spline": (MLP, SPLINE),
    "bodies": (BODIES,),
    "bodies, spline, mlp": (BODIES, SPLINE, MLP),
    "mlp, bodies": (MLP, BODIES),
}


def model_on_nodes(chain: str, count: int = 25) -> DynamicGaussians:
    """In float64, without modulation."""
    settings = {"support": NODES, "layers": CHAINS[chain], "embedding_dim": 0, "weights": chain != "no weight"}
    return random_model(count, noise=0.1, **settings).double()


def time(t: float) -> Tensor:
    return torch.tensor(t, dtype=torch.float64)


@pytest.mark.parametrize("chain", [*CHAINS, (PLANE, MLP), (MLP, PLANE, MLP)])
def test_a_pose_is_that_of_a_plain_reading(chain: str | tuple[LayerConfig, ...]) -> None:
    """Chains with a name are on nodes, by linear blend skinning; the others are on Gaussians."""
    on_nodes = isinstance(chain, str)
    model = model_on_nodes(chain) if on_nodes else random_model(25, noise=0.1, layers=chain, embedding_dim=0).double()
    posed, want = model.pose(0.37), plain_pose(model, 0.37)
    assert_close(posed.means.detach(), want.means, "network.float64")
    assert_close(posed.scales.detach(), want.scales, "network.float64")
    assert_close(posed.quats.detach(), want.quats, "network.float64")
    assert np.abs(want.means - model.gaussians.means.detach().numpy()).max() > 1e-2


@pytest.mark.parametrize("chain", CHAINS)
def test_gradients_are_those_of_the_slow_pose(chain: str) -> None:
    """Along a random direction of each parameter that moves something, by central differences of the slow pose."""
    model, generator = model_on_nodes(chain, 6), torch.Generator().manual_seed(5)
    factors = [torch.randn(6, columns, generator=generator, dtype=torch.float64) for columns in (3, 3, 4)]

    def slow() -> float:
        posed = plain_pose(model, 0.37)
        return sum(float((f.numpy() * v).sum()) for f, v in zip(factors, posed, strict=True))

    posed = model.pose(0.37)
    moved = zip(factors, (posed.means, posed.scales, posed.quats), strict=True)
    fast = torch.stack([(f * v).sum() for f, v in moved]).sum()
    names = [n for n, p in model.named_parameters() if p.requires_grad and not n.endswith(("opacities", "dc", "rest"))]
    assert {"gaussians.means", "gaussians.raw_quats", "gaussians.skinning_logits"} < set(names)
    parameters = [model.get_parameter(name) for name in names]
    gradients = torch.autograd.grad(fast, parameters)
    with torch.no_grad():
        for name, parameter, gradient in zip(names, parameters, gradients, strict=True):
            direction = torch.randn(parameter.shape, generator=generator, dtype=torch.float64)
            direction /= direction.norm()
            values = []
            for step in (1e-6, -2e-6):
                parameter += step * direction
                values.append(slow())
            parameter += 1e-6 * direction
            want = (values[0] - values[1]) / 2e-6
            got = float((gradient * direction).sum())
            assert abs(got - want) <= tolerance("skinning_gradient") * max(1.0, abs(want)), name


def test_modulation_multiplies_the_growth_of_scales() -> None:
    model = random_model(25, noise=0.3, support=NODES).double()
    modulated, modulation = model.pose(0.6), model.modulation
    assert modulation is not None
    factors = modulation(model.gaussians.attributes["embeddings"])["scales"]
    model.modulation = None
    plain, log_scales = model.pose(0.6), model.gaussians.log_scales
    assert_close((modulated.scales.log() - log_scales).detach(), (factors * (plain.scales.log() - log_scales)).detach(),
                 "network.float64")  # fmt: skip
    assert torch.equal(modulated.means, plain.means)
    assert float((factors - 1).abs().max().detach()) > 1e-2


def test_scales_grow_along_a_gaussians_own_axes() -> None:
    half = 0.5**0.5
    quats = torch.tensor([[half, 0.0, 0.0, half]], dtype=torch.float64)  # its second axis is -x
    stretch = torch.eye(3, dtype=torch.float64)
    stretch[0, 0] = 2.0  # twice as long along x
    motion = torch.cat([stretch.flatten(), torch.zeros(3), torch.tensor([1.0, 0, 0, 0])]).double()[None]
    one = torch.ones(1, 1, dtype=torch.float64)
    _, log_scales, _ = skin(torch.zeros(1, 3, dtype=torch.float64), quats, one, torch.tensor([[0]]), motion)
    assert np.abs(log_scales[0].exp().numpy() - [1, 2, 1]).max() <= EXACT


def test_a_gaussian_scaled_to_zero_keeps_a_positive_scale_and_a_finite_gradient() -> None:
    generator = torch.Generator().manual_seed(2)
    means, quats, weights, motions = (
        torch.randn(4, columns, generator=generator, dtype=torch.float64) for columns in (3, 4, 1, 16)
    )
    motions[:, :9] = 0.0
    unit = quats / quats.norm(dim=1, keepdim=True)
    motions.requires_grad_()
    deltas = skin(means, unit, torch.ones_like(weights), torch.arange(4)[:, None], motions)
    assert_close(deltas[1].exp().detach(), np.full((4, 3), MIN_STRETCH), "rotation")
    (gradient,) = torch.autograd.grad(torch.cat(deltas, dim=1).sum(), [motions])
    assert torch.isfinite(gradient).all()


def test_quaternions_as_scipy_has_them() -> None:
    a, b = torch.nn.functional.normalize(torch.randn(2, 6, 4, dtype=torch.float64), dim=2)
    ours, scipys = rotation(multiply(a, b).numpy()), rotation(a.numpy()) * rotation(b.numpy())
    assert ((ours * scipys.inv()).magnitude() <= EXACT).all()
    assert np.abs(rotation_matrices(a).numpy() - rotation(a.numpy()).as_matrix()).max() <= EXACT


def test_nodes_are_spread_among_opaque_gaussians() -> None:
    generator = torch.Generator().manual_seed(3)
    means = torch.rand(400, 3, generator=generator)
    opacities = torch.where(means[:, 0] < 0.5, 0.9, 0.01)
    support = NodesSupport(NodesConfig(num_nodes=20))
    logits, ids = support.initialize_nodes(means, opacities)
    assert bool((support.nodes[:, 0] < 0.5).all())
    assert len(support.nodes.unique(dim=0)) == 20
    nearest = torch.cdist(means, support.nodes).topk(MAX_NEAREST, largest=False).indices
    assert torch.equal(ids.sort(dim=1).values, nearest.sort(dim=1).values)
    assert torch.equal(ids.gather(1, logits.argmax(dim=1, keepdim=True)), nearest[:, :1])


def test_few_opaque_gaussians_are_no_places_for_many_nodes() -> None:
    means, opacities = torch.rand(100, 3, generator=torch.Generator().manual_seed(3)), torch.full((100,), 0.1)
    opacities[:5] = 0.9
    support = NodesSupport(NodesConfig(num_nodes=20))
    support.initialize_nodes(means, opacities)
    assert len(support.nodes.unique(dim=0)) == 20


@pytest.mark.parametrize("count", [1, 3])
def test_fewer_gaussians_than_nodes(count: int) -> None:
    support = NodesSupport(NodesConfig(num_nodes=12))
    logits, ids = support.initialize_nodes(torch.rand(count, 3), torch.full((count,), 0.1))
    assert bool(torch.isfinite(logits).all())
    assert ids.shape == (count, MAX_NEAREST)


def test_a_body_that_moves_as_one_is_rigid() -> None:
    support = NodesSupport(NodesConfig(num_nodes=6)).double()
    layer = SplineLayer(SplineConfig(num_knots=4), 6, (0.0, 1.0)).double()
    chain = MultiStepDeformation([layer])
    with torch.no_grad():
        means = torch.rand(6, 3, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
        support.initialize_nodes(means, torch.ones(6))
        rot = torch.tensor([0.8, 0.6, 0.0, 0.0], dtype=torch.float64)
        layer.rots[:] = rot
        rotated = torch.from_numpy(rotation(rot.numpy()).apply(support.nodes.numpy()))
        layer.transls[:] = rotated - support.nodes + torch.tensor([1.0, 2.0, 3.0])
        assert float(support.local_rigidity(support.motions(chain, means, time(0.4)))) <= EXACT
        layer.transls[:, 2, 0] += 0.5
        distances = torch.cdist(support.nodes, support.nodes)
        near = distances.topk(5, largest=False).indices[:, 1:]
        touched = (near == 2) | (torch.arange(6)[:, None] == 2)
        expected = torch.where(touched, 0.5 / (distances.gather(1, near) + 0.01), 0.0).mean()
        motions = support.motions(chain, means, time(0.4))
        assert float(support.local_rigidity(motions)) == pytest.approx(float(expected))
        gaussians = CanonicalPoints(means, torch.zeros(6, 4), {}, torch.zeros(6, 4))
        weighted = support.regularizers(motions, gaussians, time(0.4), torch.Generator())
        assert {name: float(term) for name, term in weighted.items()} == {"arap": pytest.approx(0.1 * float(expected))}


@pytest.mark.parametrize("layers", [(MLP, MLP), (SPLINE, MLP)], ids=["diagonal", "stretch tensor"])
@pytest.mark.parametrize(("nodes", "near"), [(1, 0.5), (3, 0.15)])
@pytest.mark.parametrize("part", ["means", "scales", "quats"])
def test_errors_of_nodes_displace_gaussians_by_at_most_their_lever_arms(
    part: str, nodes: int, near: float, layers: tuple[LayerConfig, ...]
) -> None:
    """Random errors of one kind of delta; the largest of many comes near to the bound."""
    support = NodesConfig(num_nodes=nodes)
    model, generator = random_model(40, noise=0.1, support=support, layers=layers).double(), np.random.default_rng(0)
    points, index = canonical_points(model.gaussians.rows(torch.arange(40))), Deltas._fields.index(part)
    support, size = model.support, 1e-6
    with torch.no_grad():
        deltas = model.deformation(support.points(points.means), time(0.3))
        before = support.follow(points, support.transforms(deltas)).means
        columns = deltas[index].shape[1]
        frobenius = torch.tensor([1.0] * min(columns, 3) + [2**0.5 if part == "scales" else 1.0] * (columns - 3))
        errors = size * torch.eye(3, dtype=torch.float64)[[index] * nodes]
        bounds = support.mean_error_bounds(errors, deltas, points)
        largest = torch.zeros(40, dtype=torch.float64)
        for _ in range(300):
            error = torch.from_numpy(generator.normal(size=deltas[index].shape))
            error = error / (error * frobenius).norm(dim=1, keepdim=True)
            changed = deltas._replace(**{part: deltas[index] + size * error})
            moved = support.follow(points, support.transforms(changed)).means - before
            largest = torch.maximum(largest, moved.norm(dim=1))
    assert float((largest - bounds).max()) <= size * tolerance("first_order")
    assert float((largest / bounds).median()) > near


def test_one_node_has_no_neighbor_to_move_with() -> None:
    model = random_model(5, support=NodesConfig(num_nodes=1))
    support = model.support
    assert isinstance(support, NodesSupport)
    points, t = canonical_points(model.gaussians.rows()), torch.tensor(0.4)
    terms = support.regularizers(support.motions(model.deformation, points.means, t), points, t, torch.Generator())
    assert {name: float(term) for name, term in terms.items()} == {"arap": 0.0}

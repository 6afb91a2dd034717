"""Canonical Gaussians and the posed ones that a model makes of them."""

import json
from typing import Any

import numpy as np
import pytest
import torch

from msdgs_serve.scene import Camera
from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.gaussians.bounds import first_by_pose, views_of
from msdgs_train.gaussians.canonical import CanonicalGaussians, neighbor_distances
from msdgs_train.gaussians.config import ModelConfig
from msdgs_train.gaussians.model import DynamicGaussians
from msdgs_train.gaussians.modulation import EMBEDDINGS
from msdgs_train.gaussians.scale_space import MIN_SCALE
from msdgs_train.layers.base import LayerConfig
from msdgs_train.layers.bodies import BodiesConfig
from msdgs_train.layers.mlp import MLPConfig
from msdgs_train.layers.parts import to_text
from msdgs_train.layers.plane import PlaneConfig
from msdgs_train.layers.quaternions import unit_or_identity
from msdgs_train.layers.spline import SplineConfig
from msdgs_train.supports.base import SupportConfig
from msdgs_train.supports.gaussians import GaussiansConfig
from msdgs_train.supports.nodes import NodesConfig
from tests.support.models import BODIES, NODES, SPLINE, random_model, small_config
from tests.support.tolerances import assert_close


def test_canonical_gaussians_are_activated_only():
    model = random_model()
    g, posed = model.gaussians, model.pose(0.3, deform=False)
    assert torch.equal(posed.means, g.means)
    assert torch.equal(posed.scales, g.log_scales.exp())
    assert torch.equal(posed.opacities, g.raw_opacities.sigmoid())
    assert torch.equal(posed.sh, torch.cat([g.sh_dc, g.sh_rest], dim=1))
    for got, same in zip(model.pose(0.9, num_layers=0), posed, strict=True):
        assert torch.equal(got, same)


@pytest.mark.parametrize("scale_space", ["log", "linear"])
@pytest.mark.parametrize(
    "targets", [("means",), ("scales",), ("quats",), ("means", "quats"), ("quats", "scales", "means")]
)
def test_modulated_deltas_are_added_once_before_activation(targets: tuple[Any, ...], scale_space: Any):
    """Equation 12, for the targets and nothing else."""
    model = random_model(modulation_targets=targets, scale_space=scale_space, noise=0.2).double()
    g, posed = model.gaussians, model.pose(0.3)
    deltas = model.deformation(g.means, torch.tensor(0.3, dtype=torch.float64))
    assert model.modulation is not None
    factors = model.modulation(g.attributes[EMBEDDINGS])
    assert list(factors) == [name for name in ("means", "scales", "quats") if name in targets]
    assert all((f - 1).abs().max() > 1e-3 for f in factors.values())
    means, scales, quats = (factors.get(name, 1.0) * getattr(deltas, name) for name in ("means", "scales", "quats"))
    raw = unit_or_identity(g.raw_quats) + quats
    linear = g.log_scales.exp() + scales
    if scale_space == "linear":
        assert 0 < (linear < 0).sum() < linear.numel() / 2
    wanted_scales = (g.log_scales + scales).exp() if scale_space == "log" else linear.abs().clamp(min=MIN_SCALE)
    assert_close(posed.means.detach(), (g.means + means).detach(), "network.float64")
    assert_close(posed.scales.detach(), wanted_scales.detach(), "network.float64")
    assert_close(posed.quats.detach(), (raw / raw.norm(dim=1, keepdim=True)).detach(), "network.float64")


@pytest.mark.parametrize("heads", [{"opacity_head": True}, {"sh_head": True}, {"opacity_head": True, "sh_head": True}])
@pytest.mark.parametrize("layers", [("mlp", "mlp"), ("plane",), ("plane", "mlp")])
def test_heads_of_opacity_and_color(heads: dict[str, bool], layers: tuple[str, ...]):
    model = random_model(layers=layers, **heads)
    early, late, canonical = model.pose(0.1), model.pose(0.9), model.pose(0.1, deform=False)
    for name, head in (("opacities", "opacity_head"), ("sh", "sh_head")):
        moves = not torch.equal(getattr(early, name), getattr(late, name))
        assert moves == heads.get(head, False)
        assert torch.equal(getattr(early, name), getattr(canonical, name)) != moves
    assert ((late.opacities > 0) & (late.opacities < 1)).all()
    assert torch.equal(model.pose(0.1, sh_degree=1).sh, early.sh[:, :4])


def test_stopping_after_a_step_is_a_model_of_fewer_layers():
    model, shorter = random_model(layers=("mlp",) * 3), random_model(layers=("mlp",))
    shorter.load_state_dict(model.state_dict(), strict=False)
    for got, want in zip(model.pose(0.6, num_layers=1), shorter.pose(0.6), strict=True):
        assert torch.equal(got, want)


def test_time_as_number_and_as_tensor_agree():
    model = random_model()
    assert torch.equal(model.pose(0.25).means, model.pose(torch.tensor(0.25)).means)


def test_ids_pose_only_these():
    model = random_model().double()
    ids = torch.tensor([7, 0, 299, 7])
    for some, every in zip(model.pose(0.5, ids=ids), model.pose(0.5), strict=True):
        assert_close(some.detach(), every[ids].detach(), "network.float64")


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_sh_bands_above_a_degree_are_omitted(degree: int):
    model = random_model()
    assert torch.equal(model.pose(0.5, sh_degree=degree).sh, model.pose(0.5).sh[:, : (degree + 1) ** 2])
    assert random_model(sh_degree=degree).pose(0.5).sh.shape == (300, (degree + 1) ** 2, 3)


@pytest.mark.parametrize("support", [GaussiansConfig(), NodesConfig(num_nodes=1)])
@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_gaussians(count: int, support: SupportConfig):
    posed = random_model(count, support=support, layers=("mlp", "plane")).pose(0.5)
    torch.cat([tensor.flatten() for tensor in posed]).sum().backward()
    assert [len(tensor) for tensor in posed] == [count] * 5
    assert all(tensor.isfinite().all() for tensor in posed)


def test_every_parameter_is_reached_by_gradients():
    model = random_model()
    for t in (0.1, 0.5, 0.9):
        torch.stack([tensor.square().sum() for tensor in model.pose(t)]).sum().backward()
    for name, parameter in model.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.any(), name


def test_detached_means_get_the_gradient_of_a_translation():
    for detach in (True, False):
        model = random_model(support=GaussiansConfig(detach_deform_input=detach))
        gradient = torch.autograd.grad(model.pose(0.3).means.sum(), model.gaussians.means)[0]
        assert torch.equal(gradient, torch.ones(300, 3)) == detach


def test_quaternions_without_direction_become_identity():
    raw = torch.tensor([[0.0, 0, 0, 0], [1e-9, 0, 0, 0], [0, 3.0, 0, -4.0]], requires_grad=True)
    quats = unit_or_identity(raw)
    assert torch.equal(quats, torch.tensor([[1.0, 0, 0, 0], [1.0, 0, 0, 0], [0, 0.6, 0, -0.8]]))
    quats[:, 1].sum().backward()
    assert raw.grad is not None
    assert raw.grad.isfinite().all()


@pytest.mark.parametrize(
    ("field", "value"),
    [
        *(("sh_degree", degree) for degree in (4, -1)),
        *(("layers", layers) for layers in (-1, 1.5, True, "mlp")),
        *(("layers.0` must be of another kind", (layer,)) for layer in (SPLINE, BODIES)),  # curves are of nodes
        ("support", "nodes"),
        *(("support.num_nodes", NodesConfig(num_nodes=count)) for count in (0, 2.0)),  # pyright: ignore
        *(("support.k_nearest", NodesConfig(k_nearest=count)) for count in (0, 9)),
        ("embedding_dim", -1),
        ("scale_space", "activated"),
        ("weights", 1),
        *(("eps2d", eps2d) for eps2d in (-0.1, float("nan"), float("inf"), "0.3", True)),
        ("modulation_lr_init", 0.0),
        *(("modulation_targets", targets) for targets in ((), ("scales", "scales"), ("opacities",))),
    ],
)
def test_impossible_settings_are_refused_by_name(field: str, value: Any):
    with pytest.raises(InvalidInput, match=rf"model\.{field}"):
        ModelConfig(**{field.split(".")[0]: value})


@pytest.mark.parametrize("field", ["scale_space", "opacity_head", "sh_head"])
def test_what_nodes_cannot_change_is_refused(field: str):
    with pytest.raises(InvalidInput, match=f"model.{field}"):
        ModelConfig(support=NODES, **{field: "linear" if field == "scale_space" else True})  # pyright: ignore


@pytest.mark.parametrize(
    ("setting", "layer"),
    [
        ("width", MLPConfig(width=0)),
        ("depth", MLPConfig(depth=0)),
        ("time_width", MLPConfig(time_width=0)),
        ("xyz_frequencies", MLPConfig(xyz_frequencies=-1)),
        ("skip", MLPConfig(skip=4)),
        ("resolution", PlaneConfig(resolution=1)),
        ("features", PlaneConfig(features=0)),
        ("multires", PlaneConfig(multires=())),
        ("multires", PlaneConfig(multires=(1, 0))),
        ("num_knots", SplineConfig(num_knots=-1)),
        ("num_bodies", BodiesConfig(num_bodies=0)),
        ("lr_init", BodiesConfig(lr_init=0.0)),
        ("body_smoothness_weight", BodiesConfig(body_smoothness_weight=-1.0)),
    ],
)
def test_impossible_sizes_are_refused_by_layer_and_name(setting: str, layer: LayerConfig):
    with pytest.raises(InvalidInput, match=rf"model\.layers\.1\.{setting}"):
        ModelConfig(support=NODES, layers=(MLPConfig(), layer))


@pytest.mark.parametrize(
    ("layers", "message"),
    [
        (["grid"], r"model\.layers\.0.*\(mlp, plane, spline.*--plugin"),
        (["mlp:width=96", "mlp:hight=3"], r"model\.layers\.1.*width.*`hight`"),
        (["mlp:width=wide"], r"model\.layers\.0"),
        (["mlp:96"], r"model\.layers\.0"),
        (["mlp:width=9.5"], r"model\.layers\.0\.width"),
        ([{"kind": "mlp", "width": "wide"}], r"model\.layers\.0\.width"),
        ([{"width": 3}], r"model\.layers\.0"),
        ([3], r"model\.layers\.0"),
    ],
)
def test_parts_that_cannot_be_read_are_named(layers: list[Any], message: str):
    with pytest.raises(InvalidInput, match=message):
        ModelConfig.from_dict({"layers": layers})


def test_parts_as_text_as_values_and_as_settings_are_the_same():
    layer = PlaneConfig(features=4, multires=(1, 2), lr_init=1.0)
    text = "plane:features=4,multires=(1, 2),lr_init=1.0"
    values = {"kind": "plane", "features": 4, "multires": [1, 2], "lr_init": 1}
    assert to_text(layer) == text
    assert ModelConfig.from_dict({"layers": [text, values, layer]}).layers == (layer, layer, layer)
    config = small_config(layers=(layer, "mlp"))
    assert ModelConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config
    assert to_text(MLPConfig()) == "mlp"
    off = [ModelConfig.from_dict({"support": "nodes", "layers": [f"spline:affine={no}"]}) for no in ("false", "False")]
    assert all(config.layers == (SplineConfig(affine=False),) for config in off)
    words = ("mlp:width=8,initialization=torch", "mlp:width=8,initialization='torch'")
    assert ModelConfig.from_dict({"layers": words}).layers == (MLPConfig(width=8, initialization="torch"),) * 2


@pytest.mark.parametrize(
    ("field", "change"),
    [
        ("log_scales", {"count": 4}),
        ("sh_rest", {"sh_degree": 2}),
        ("embeddings", {"attributes": small_config(embedding_dim=9).attributes()}),
        ("embeddings", {"attributes": {}}),
        ("node_ids", {"attributes": small_config(support=NODES).attributes()}),
    ],
)
def test_tensors_that_disagree_are_refused_by_name(field: str, change: dict[str, Any]):
    sizes = {"count": 5, "scene_half_size": 1.0, "sh_degree": 3, "seed": 0, "attributes": small_config().attributes()}
    gaussians, other = (dict(CanonicalGaussians.random_in_cube(**sizes | c).named_parameters()) for c in ({}, change))
    gaussians.pop(field, None)
    mixed = CanonicalGaussians(**gaussians | {name: other[name] for name in [field] if name in other})
    with pytest.raises(InvalidInput, match=f"gaussians.{field}"):
        DynamicGaussians(small_config(), mixed)


def test_random_start_fills_the_cube_and_repeats():
    a, b, c = (CanonicalGaussians.random_in_cube(500, 1.3, 3, seed) for seed in (1, 1, 2))
    assert torch.equal(a.means, b.means)
    assert not torch.equal(a.means, c.means)
    assert 1.2 < a.means.abs().max() <= 1.3
    assert torch.allclose(a.raw_opacities.sigmoid(), torch.tensor(0.1))
    assert torch.equal(a.log_scales[:, 0].exp().log(), a.log_scales[:, 2].exp().log())


def test_random_start_in_view_of_cameras():
    target, up = np.zeros(3), np.array([0.0, 1.0, 0.0])
    cameras = [Camera.from_look_at(np.array(eye), target, up, 20, 20, 20.0) for eye in ((0, 0, -4.0), (4.0, 0, 0))]
    made = [
        CanonicalGaussians.random_in_cube(500, 1.3, 0, 1, in_view=lambda points, n=n: views_of(points, cameras) >= n)
        for n in (1, 2, 3)
    ]
    views = [views_of(gaussians.means.detach().numpy(), cameras) for gaussians in made]
    assert [int(counts.min()) for counts in views] == [1, 2, 0], "anywhere if no point is in view"
    assert [len(gaussians) for gaussians in made] == [500] * 3
    assert first_by_pose([*cameras, cameras[0].resized(10, 10)], lambda camera: camera) == cameras[:2]


@pytest.mark.parametrize("spread", ["uniform", "clustered", "plane", "line"])
@pytest.mark.parametrize("count", [2, 3, 4, 5, 300])
def test_neighbor_distances_against_all_pairs(spread: str, count: int):
    generator = torch.Generator().manual_seed(count)
    points = torch.rand(count, 3, generator=generator)
    points = {
        "uniform": points,
        "clustered": points * 1e-3 + (points[:, :1] > 0.5) * 5.0,
        "plane": points * torch.tensor([0.0, 1.0, 1.0]),
        "line": points * torch.tensor([1.0, 0.0, 0.0]),
    }[spread]
    pairs = (points[:, None] - points[None]).double().norm(dim=2).sort(dim=1).values
    want = pairs[:, 1 : min(count, 4)].mean(dim=1)
    assert_close(neighbor_distances(points), want.float(), "neighbor_distances")


def test_neighbor_distances_of_points_alone_and_in_one_place():
    for n in (0, 1):
        assert torch.equal(neighbor_distances(torch.rand(n, 3)), torch.ones(n))
    assert torch.equal(neighbor_distances(torch.ones(20, 3)), torch.zeros(20))
    gaussians = CanonicalGaussians.from_points(torch.zeros(5, 3), torch.rand(5, 3), 0, torch.Generator())
    assert gaussians.log_scales.isfinite().all()


def test_a_point_that_is_not_finite_has_no_neighbors():
    points = torch.rand(5, 3)
    points[2, 1] = torch.nan
    with pytest.raises(InvalidInput, match="`points` must be finite, got 1 of 5"):
        neighbor_distances(points)

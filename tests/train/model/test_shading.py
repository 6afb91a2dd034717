"""Shading: nodes scale the colors of the Gaussians that follow them, over time."""

from dataclasses import replace
from typing import cast

import numpy as np
import torch
from torch import Tensor

from msdgs_train.gaussians.model import DynamicGaussians, shaded
from msdgs_train.layers.base import PAPER_HEADS, SceneBounds
from msdgs_train.layers.spline import SplineLayer
from msdgs_train.supports.torch_skinning import blend
from tests.support.models import MLP, NODES, SHADING, random_model
from tests.support.reference import sh_basis
from tests.support.reference_deformation import array, plain_curves
from tests.support.tolerances import assert_close


def shading_model(count: int = 25, sh_degree: int = 2) -> DynamicGaussians:
    """In float64; two of its three layers shade."""
    layers = (SHADING, MLP, replace(SHADING, num_knots=5))
    settings = {"support": NODES, "layers": layers, "embedding_dim": 0, "sh_degree": sh_degree}
    return random_model(count, noise=0.3, **settings).double()


def colors(sh: Tensor, directions: np.ndarray) -> np.ndarray:
    """[N, 3] seen along unit directions, [N, 3]."""
    degree = int(sh.shape[1] ** 0.5) - 1
    return 0.5 + np.einsum("nk,nkc->nc", sh_basis(directions, degree), array(sh))


def test_colors_are_multiplied_by_the_weighted_mean_over_nodes() -> None:
    model, t = shading_model(), 0.37
    directions = np.random.default_rng(0).normal(size=(25, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    curves = [cast(SplineLayer, model.deformation.layers[k]) for k in (0, 2)]
    gains = np.sum([plain_curves(layer, [cast(Tensor, layer.gains)], t) for layer in curves], axis=0)
    logits, ids = array(model.gaussians.attributes["skinning_logits"]), model.gaussians.attributes["node_ids"]
    weights = np.exp(logits) / np.exp(logits).sum(axis=1, keepdims=True)
    own = np.stack([of @ gains[followed] for of, followed in zip(weights, ids.numpy(), strict=True)])
    still = colors(model.pose(t, deform=False).sh, directions)
    assert_close(colors(model.pose(t).sh, directions), still * (1 + own), "network.float64")
    assert np.abs(own).max() > 0.1


def test_lower_bands_are_shaded_as_all_are() -> None:
    model = shading_model()
    assert torch.equal(model.pose(0.4, sh_degree=1).sh, model.pose(0.4).sh[:, :4])
    assert shading_model(sh_degree=0).pose(0.4).sh.shape == (25, 1, 3)


def test_gradients_of_shading() -> None:
    generator = torch.Generator().manual_seed(0)
    made = [torch.randn(shape, generator=generator, dtype=torch.float64) for shape in ((5, 3), (7, 2))]
    values, weights = (tensor.requires_grad_() for tensor in made)
    ids = torch.randint(5, (7, 2), generator=generator)
    assert torch.autograd.gradcheck(lambda v, w: blend(w, ids, v), (values, weights))
    parts = [torch.randn(7, k, 3, generator=generator, dtype=torch.float64, requires_grad=True) for k in (1, 8, 1)]
    assert torch.autograd.gradcheck(shaded, tuple(parts))


def test_shading_is_held_beyond_the_window_and_has_its_own_rate_and_smoothness() -> None:
    config = replace(SHADING, num_knots=40)
    layer = cast(SplineLayer, config.build(SceneBounds(), PAPER_HEADS, 2))
    assert layer.gains is not None
    with torch.no_grad():
        layer.gains[:, 0, 0] = torch.arange(43.0) ** 2
    time = torch.tensor(0.5)
    terms = layer.regularizers(torch.zeros(2, 3), time, torch.Generator())
    expected = config.shading_smoothness_weight * 2.0 / 6  # second differences of 2 in one of six curves
    assert_close(terms["shading_smoothness"].detach(), torch.tensor(expected), "float32.relative")
    layer.on_window(0.1, 0.2)
    held = layer.gains.detach()[:, 0, 0]
    assert held[0] == held[10] > 0
    assert held[-1] == held[-10] < 42**2
    rates = {group.name: group.lr.init for group in layer.parameter_groups()}
    assert rates == {"curves": config.lr_init, "gains": config.shading_lr_init}


def test_a_model_without_shading_has_no_gains() -> None:
    model = random_model(5, support=NODES, layers=("spline",), embedding_dim=0)
    assert not any("gains" in name for name in model.state_dict())
    assert torch.equal(model.pose(0.9).sh, model.pose(0.1).sh)

"""Small models with something to say: every parameter is random, so nothing is zero by its initialisation."""

from typing import Any

import torch

from msdgs_train.gaussians.canonical import CanonicalGaussians
from msdgs_train.gaussians.config import ModelConfig
from msdgs_train.gaussians.model import DynamicGaussians
from msdgs_train.gaussians.model_file import SceneInfo
from msdgs_train.layers.base import LayerConfig
from msdgs_train.layers.mlp import MLPConfig
from msdgs_train.layers.plane import PlaneConfig
from msdgs_train.layers.spline import SplineConfig
from msdgs_train.supports.nodes import NodesConfig, NodesSupport

torch.set_num_threads(1)
"""The tests themselves run side by side, and OpenMP threads that wait for a core spin."""

CAMERA = {
    "fx": 50.0,
    "fy": 50.0,
    "cx": 32.0,
    "cy": 24.0,
    "width": 64,
    "height": 48,
    "camera_to_world": [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, -4.0], [0.0, 0.0, 0.0, 1.0]],
}
SCENE = SceneInfo(
    time_range=(0.0, 1.0),
    background=(1.0, 1.0, 1.0),
    bounds=[[-1.3] * 3, [1.3] * 3],
    cameras=[{"name": f"r_{i:03}", "t": i / 29, **CAMERA} for i in range(30)],
)


MLP = MLPConfig(width=32, depth=3, time_width=16, time_features=8)
PLANE = PlaneConfig()
SPLINE = SplineConfig(num_knots=3)
SMALL_LAYERS: dict[str, LayerConfig] = {layer.kind: layer for layer in (MLP, PLANE, SPLINE)}
NODES = NodesConfig(num_nodes=4)


def small_config(**changes: Any) -> ModelConfig:
    """Two layers of width 32; `layers` may name a kind of `SMALL_LAYERS` instead of its settings."""
    values: dict[str, Any] = {"layers": ("mlp", "mlp"), "embedding_dim": 8} | changes
    layers = [SMALL_LAYERS[layer] if isinstance(layer, str) else layer for layer in values.pop("layers")]
    return ModelConfig(layers=tuple(layers), **values)


def random_model(count: int = 300, seed: int = 0, noise: float = 0.05, **config: Any) -> DynamicGaussians:
    """A model whose Gaussians and networks all differ from their start by normal noise."""
    settings = small_config(**config)
    gaussians = CanonicalGaussians.random_in_cube(count, 1.3, settings.sh_degree, seed, settings.attributes())
    with torch.random.fork_rng(), torch.no_grad():
        torch.manual_seed(seed)
        model = DynamicGaussians(settings, gaussians)
        if isinstance(model.support, NodesSupport):
            _place_nodes(model.support, gaussians)
        for parameter in model.parameters():
            if parameter.requires_grad and parameter is not gaussians.means:
                parameter += noise * torch.randn_like(parameter)
    return model


def _place_nodes(support: NodesSupport, gaussians: CanonicalGaussians) -> None:
    """Nodes among the Gaussians, each of which follows the nearest; at random if there are no Gaussians."""
    if len(gaussians) == 0:
        support.nodes.normal_()
        return
    logits, ids = support.initialize_nodes(gaussians.means, gaussians.raw_opacities.sigmoid())
    gaussians.get_parameter("skinning_logits").copy_(logits)
    gaussians.get_parameter("node_ids").copy_(ids)

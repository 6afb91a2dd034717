"""Small models with something to say: every parameter is random, so nothing is zero by its initialisation."""

from typing import Any

import torch

from msdgs_train.gaussians.canonical import CanonicalGaussians
from msdgs_train.gaussians.model import DynamicGaussians, ModelConfig
from msdgs_train.gaussians.model_file import SceneInfo

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


def small_config(**changes: Any) -> ModelConfig:
    """Two layers of width 32."""
    sizes: dict[str, Any] = {
        "layers": ("mlp", "mlp"),
        "width": 32,
        "depth": 3,
        "time_width": 16,
        "time_features": 8,
        "embedding_dim": 8,
    }
    return ModelConfig(**(sizes | changes))


def random_model(count: int = 300, seed: int = 0, noise: float = 0.05, **config: Any) -> DynamicGaussians:
    """A model whose Gaussians and networks all differ from their start by normal noise."""
    settings = small_config(**config)
    gaussians = CanonicalGaussians.random_in_cube(
        count, 1.3, settings.sh_degree, settings.embedding_dim, seed, settings.motions
    )
    with torch.random.fork_rng(), torch.no_grad():
        torch.manual_seed(seed)
        model = DynamicGaussians(settings, gaussians)
        if gaussians.node_ids is not None:
            gaussians.node_ids.add_(torch.randint(settings.num_nodes, (count, 1))).remainder_(settings.num_nodes)
        for parameter in model.parameters():
            if parameter.requires_grad and parameter is not gaussians.means:
                parameter += noise * torch.randn_like(parameter)
    return model

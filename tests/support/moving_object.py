"""Made models in which one part moves and all else stands still, exactly."""

from typing import Any

import torch

from msdgs_train.gaussians.canonical import CanonicalGaussians
from msdgs_train.gaussians.model import DynamicGaussians
from msdgs_train.layers.mlp import MLPLayer
from tests.support.models import small_config

GROUND, OBJECT = 200, 40
"""Gaussians of each, the ground's first."""

NODE_RADIUS = 0.3
"""Scene units that the object moves by per unit of time, about."""


def moving_object(seed: int = 0, moves: bool = True, **config: Any) -> DynamicGaussians:
    """Still ground at x < 0.3, and an object at x > 0.9 that rises; without `moves`, no layer moves anything.

    Besides what it needs the model has a second layer that does nothing, SH bands of zeros, modulation that is 1, and
    heads of scales and rotations that are zero.
    """
    settings = small_config(**({"layers": ("mlp", "mlp"), "depth": 1, "sh_degree": 1} | config))
    generator = torch.Generator().manual_seed(seed)
    count = GROUND + OBJECT
    points = 2 * torch.rand(count, 3, generator=generator) - 1
    points[:GROUND, 0] = 0.3 - 1.2 * torch.rand(GROUND, generator=generator)
    points[GROUND:, 0] = 0.9 + 0.3 * torch.rand(OBJECT, generator=generator)
    colors = torch.rand(count, 3, generator=generator)
    gaussians = CanonicalGaussians.from_points(points, colors, settings.sh_degree, settings.embedding_dim, generator)
    with torch.no_grad():
        gaussians.log_scales.fill_(-2.3)
        gaussians.raw_opacities.fill_(2.0)
        model = DynamicGaussians(settings, gaussians)
        for layer in model.deformation.layers:
            for parameter in layer.parameters():
                parameter.zero_()
        if moves:
            rise(model.deformation.layers[0])
    return model


def rise(layer: torch.nn.Module) -> None:
    """Make a layer of zeros answer at x > 0.8 alone, and move upwards in proportion to the time."""
    assert isinstance(layer, MLPLayer)
    layer.time_hidden.weight[0, 0] = 1
    layer.time_output.weight[0, 0] = 1  # the first feature of time is the time
    layer.first.weight[0, 0] = 10
    layer.first.weight[0, layer.xyz_features] = 4
    layer.first.bias[0] = -8
    layer.first.weight[1, 0] = 10
    layer.first.bias[1] = -8
    layer.heads.weight[1, 0] = -NODE_RADIUS  # units 0 and 1 differ by 4 t where x > 0.8; the weight is a half
    layer.heads.weight[1, 1] = NODE_RADIUS

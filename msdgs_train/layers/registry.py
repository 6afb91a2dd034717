"""The kinds of layers by name. A kind from outside this package joins with `register_layer`."""

from msdgs_train.layers.base import LayerConfig
from msdgs_train.layers.bodies import BodiesConfig
from msdgs_train.layers.hash4d import Hash4DConfig
from msdgs_train.layers.mlp import MLPConfig
from msdgs_train.layers.plane import PlaneConfig
from msdgs_train.layers.spline import SplineConfig

LAYERS: dict[str, type[LayerConfig]] = {
    config.kind: config for config in (MLPConfig, PlaneConfig, SplineConfig, Hash4DConfig, BodiesConfig)
}


def register_layer(config: type[LayerConfig]) -> None:
    """Make a kind known under its `kind`."""
    LAYERS[config.kind] = config

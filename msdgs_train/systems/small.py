"""Sizes of a model for two cores."""

from msdgs_train.gaussians.config import ModelConfig
from msdgs_train.layers.mlp import MLPConfig

SMALL_LAYER = MLPConfig(width=96, depth=2, xyz_frequencies=4, time_width=64)
SMALL_MODEL = ModelConfig(sh_degree=2, layers=(SMALL_LAYER, SMALL_LAYER))

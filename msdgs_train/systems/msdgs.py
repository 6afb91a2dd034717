"""The paper's two systems, and a small one for two cores."""

from msdgs_train.engine.config import TrainConfig
from msdgs_train.gaussians.config import ModelConfig
from msdgs_train.layers.mlp import MLPConfig
from msdgs_train.layers.plane import PlaneConfig
from msdgs_train.systems.deformgs import PUBLISHED
from msdgs_train.systems.registry import register_system
from msdgs_train.systems.small import SMALL_MODEL

PAPER_LAYERS = 10

register_system("msdgs-small", "two small MLP layers on the Gaussians themselves", TrainConfig(model=SMALL_MODEL))

register_system(
    "msdgs-mlp",
    "the paper's system with 10 MLP layers",
    PUBLISHED.updated(model=ModelConfig(layers=(MLPConfig(lr_init=8e-4, lr_final=1.6e-6),) * PAPER_LAYERS)),
)

_PLANE = PlaneConfig(lr_init=8e-4, lr_final=1.6e-6, grid_lr_init=8e-3, grid_lr_final=8e-5)
register_system(
    "msdgs-plane",
    "the paper's system with 10 plane layers",
    PUBLISHED.updated(model=ModelConfig(layers=(_PLANE,) * PAPER_LAYERS)),
)

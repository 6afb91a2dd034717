"""3D Gaussian Splatting (Kerbl et al. 2023): a scene without motion."""

from dataclasses import replace

from msdgs_train.engine.config import TrainConfig
from msdgs_train.systems.registry import register_system
from msdgs_train.systems.small import SMALL_MODEL

register_system(
    "static",
    "no motion: 3D Gaussian Splatting",
    TrainConfig().updated(
        model=replace(SMALL_MODEL, layers=(), embedding_dim=0), static_fraction=0.0, window_full_fraction=0.0
    ),
)

"""Deformable-3D-Gaussians (Yang et al. 2024): one deep MLP, whose deltas are added to activated scales."""

from msdgs_train.engine.config import TrainConfig
from msdgs_train.gaussians.config import ModelConfig
from msdgs_train.layers.mlp import MLPConfig
from msdgs_train.systems.registry import register_system

NO_CAP = 10**9
"""Gaussians at most, in loops without an upper bound."""

PUBLISHED = TrainConfig().updated(
    steps=40_000,
    background="black",
    init_num_pts=100_000,
    max_gaussians=150_000,
    static_fraction=3_000 / 40_000,  # its warm_up
    sh_degree_fraction=1_000 / 40_000,
    grow_grad2d=2e-4,
    refine_stop_fraction=15_000 / 40_000,
    refine_start_fraction=500 / 40_000,
    refine_every_fraction=100 / 40_000,
    reset_every_fraction=3_000 / 40_000,
)
"""Its settings for D-NeRF, which most later systems share."""

register_system(
    "deformgs",
    "Deformable-3D-Gaussians",
    PUBLISHED.updated(
        model=ModelConfig(
            layers=(MLPConfig(depth=8, skip=5, lr_init=8e-4, lr_final=1.6e-6),),
            weights=False,
            embedding_dim=0,
            scale_space="linear",
        )
    ),
)

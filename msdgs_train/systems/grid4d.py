"""Grid4D (Xu et al. 2024): hash grids over space and time, whose deltas are added to activated scales.

Constants of its commit c9a93fb for D-NeRF: arguments/, train.py and scene/. Those for lego differ from the others'.
"""

from msdgs_train.engine.config import TrainConfig
from msdgs_train.gaussians.config import ModelConfig
from msdgs_train.layers.hash4d import Hash4DConfig
from msdgs_train.systems.deformgs import NO_CAP, PUBLISHED
from msdgs_train.systems.faithful import published
from msdgs_train.systems.registry import register_system

STEPS = 50_000
LOOP = PUBLISHED.updated(
    steps=STEPS,
    static_fraction=2_999 / STEPS,
    sh_degree_fraction=1_000 / STEPS,
    refine_every_fraction=100 / STEPS,
    reset_every_fraction=3_000 / STEPS,
    means_lr_until_fraction=35_000 / STEPS,
    max_gaussians=NO_CAP,
)

register_system(
    "grid4d",
    "Grid4D with its own loop",
    published(
        LOOP,
        ModelConfig(
            layers=(Hash4DConfig(initialization="torch"),),
            weights=False,
            embedding_dim=0,
            scale_space="linear",
            quat_space="raw",
        ),
    ),
)

register_system(
    "grid4d-small",
    "Grid4D with fewer levels and units, for CPUs",
    TrainConfig().updated(
        model=ModelConfig(
            sh_degree=2,
            layers=(Hash4DConfig(levels=8, canonical_log2_rows=15, width=64),),
            weights=False,
            embedding_dim=0,
            scale_space="linear",
        ),
        window_full_fraction=0.0,
    ),
)

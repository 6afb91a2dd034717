"""SC-GS (Huang et al. 2024): Gaussians on sparse control nodes, chosen in a first stage from their motion."""

from dataclasses import replace

from msdgs_serve.rasterizer import INRIA
from msdgs_train.engine.config import TrainConfig
from msdgs_train.gaussians.config import ModelConfig
from msdgs_train.layers.mlp import MLPConfig
from msdgs_train.supports.scgs import SCGSConfig
from msdgs_train.systems.deformgs import NO_CAP, PUBLISHED
from msdgs_train.systems.registry import register_system
from msdgs_train.systems.scgs.settings import SCGSSettings
from msdgs_train.systems.scgs.system import SCGS

MODEL = ModelConfig(
    support=SCGSConfig(),
    layers=(MLPConfig(depth=8, skip=5, lr_init=8e-4, lr_final=1.6e-6),),
    weights=False,
    embedding_dim=0,
    scale_space="linear",
    near_plane=INRIA.near_plane,
    alpha_max=INRIA.alpha_max,
)

PRESET: TrainConfig = PUBLISHED.updated(
    model=MODEL,
    own=SCGSSettings(),
    steps=90_000,
    static_fraction=0.0,
    static_window_fraction=0.0,
    window_full_fraction=0.0,
    gradient_clip=None,
    init_gray=0.5,
    max_gaussians=NO_CAP,
    means_lr_until_fraction=30_000 / 80_000,
    sh_degree_fraction=1_000 / 80_000,
    refine_start_fraction=501 / 80_000,
    refine_stop_fraction=49_999 / 80_000,
    refine_every_fraction=100 / 80_000,
    reset_every_fraction=3_000 / 80_000,
)

register_system("sc-gs", "SC-GS: Gaussians on 512 control nodes with learned radii, in two stages", PRESET, SCGS)

SMALL = replace(
    MODEL,
    sh_degree=2,
    support=SCGSConfig(num_nodes=256),
    layers=(MLPConfig(width=96, depth=4, skip=3, time_width=64, lr_init=8e-4, lr_final=1.6e-6),),
)

register_system(
    "sc-gs-small",
    "SC-GS for CPUs: 256 control nodes and a smaller network",
    PRESET.updated(
        model=SMALL,
        steps=10_000,
        init_num_pts=8_000,
        max_gaussians=None,
        init_min_views=0.5,
        refine_every_fraction=1 / 400,
        grow_grad2d=5e-4,
        node_refine_every_fraction=1 / 25,
        gaussians_per_node=16,
    ),
    SCGS,
)

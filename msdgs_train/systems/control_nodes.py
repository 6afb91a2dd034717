"""Chains of layers on control nodes, which carry the Gaussians: the default system, and one with a coarser first step.

The default's first layer has a spline of each node's own, which follows fast objects as the time window grows; the MLP
layers after it share what nearby nodes have in common. In `msdgs-bodies` a few rigid bodies move the nodes before.
"""

from dataclasses import replace

from msdgs_train.engine.config import TrainConfig
from msdgs_train.gaussians.config import ModelConfig
from msdgs_train.layers.bodies import BodiesConfig
from msdgs_train.layers.spline import SplineConfig
from msdgs_train.supports.nodes import NodesConfig
from msdgs_train.systems.registry import DEFAULT, register_system
from msdgs_train.systems.small import SMALL_LAYER

MODEL = ModelConfig(
    sh_degree=2,
    support=NodesConfig(num_nodes=512, k_nearest=4, skinning_lr_final=6e-3),
    layers=(SplineConfig(), SMALL_LAYER, SMALL_LAYER),
    embedding_dim=0,
    eps2d=0.15,
)
CONFIG = TrainConfig().updated(
    model=MODEL,
    steps=20_000,
    static_fraction=0.05,
    window_full_fraction=0.65,
    half_resolution_fraction=0.35,
    eps2d_init=0.3,
    ema_fraction=1 / 40,
    sh_degree_fraction=1 / 20,
    refine_start_fraction=1 / 80,
    refine_every_fraction=1 / 400,
    refine_stop_fraction=0.75,
    init_min_views=0.5,
    max_gaussians=None,
    prune_unseen_passes=1.5,
    grow_grad2d=5e-4,
    opacity_reg=0.01,
    means_lr_final=5e-5,
    mse_fraction=0.8,
    alpha_weight=0.1,
)

register_system(DEFAULT, "a spline layer and 2 MLP layers on 512 control nodes, which carry the Gaussians", CONFIG)
register_system(
    "msdgs-bodies",
    "32 rigid bodies, then the layers of msdgs-nodes: coarse to fine",
    CONFIG.updated(model=replace(MODEL, layers=(BodiesConfig(), *MODEL.layers))),
)

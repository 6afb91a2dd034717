"""Whole sets of settings by name: the paper's two systems, the systems it compares with, a small one, and no motion.

All share this project's procedure (the growing time window included) and differ in what their authors say of them:
networks, where deltas are added, losses, learning rates, schedules, numbers of Gaussians, background.
"""

from dataclasses import replace

from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.engine.config import TrainConfig
from msdgs_train.gaussians.config import ModelConfig

DEFAULT = "msdgs-small"
PAPER_LAYERS = 10

_FIELD = TrainConfig(
    steps=40_000,
    background="black",
    init_num_pts=100_000,
    max_gaussians=150_000,
    static_fraction=3_000 / 40_000,
    sh_degree_interval=1_000,
    deform_lr_init=8e-4,
    deform_lr_final=1.6e-6,
    grow_grad2d=2e-4,
    refine_stop_fraction=15_000 / 40_000,
    reset_every=3_000,
)
"""As Deformable-3D-Gaussians trains on D-NeRF, and most who came after it."""

_4DGS_EXTENT = 5.0  # scene units; 4DGS multiplies its rates by it
_4DGS_PLANES = 3  # 4DGS sums the smoothness of three planes, where this project takes the mean

PRESETS: dict[str, TrainConfig] = {
    DEFAULT: TrainConfig(),
    "msdgs-mlp": replace(_FIELD, model=ModelConfig(layers=("mlp",) * PAPER_LAYERS)),
    "msdgs-plane": replace(
        _FIELD,
        model=ModelConfig(layers=("plane",) * PAPER_LAYERS),
        grid_lr_init=8e-3,
        grid_lr_final=8e-5,
    ),
    "deformgs": replace(
        _FIELD,
        model=ModelConfig(layers=("mlp",), depth=8, skip=5, weights=False, embedding_dim=0, delta_space="activated"),
    ),
    "4dgs": replace(
        _FIELD,
        model=ModelConfig(
            layers=("plane",),
            plane_features_dim=32,
            plane_resolution=64,
            plane_time_resolution=75,
            plane_width=64,
            multires=(1, 2),
            weights=False,
            embedding_dim=0,
            detach_deform_input=False,
        ),
        steps=23_000,
        background="white",
        init_num_pts=2_000,
        static_fraction=3_000 / 23_000,
        refine_stop_fraction=15_000 / 23_000,
        deform_lr_init=1.6e-4 * _4DGS_EXTENT,
        deform_lr_final=1.6e-6 * _4DGS_EXTENT,
        grid_lr_init=1.6e-3 * _4DGS_EXTENT,
        grid_lr_final=1.6e-5 * _4DGS_EXTENT,
        l1_weight=1.0,
        time_smoothness_weight=1e-2 * _4DGS_PLANES,
        plane_tv_weight=0.0,
        plane_smoothness_weight=1e-4 * _4DGS_PLANES,
        l1_time_planes_weight=1e-4 * _4DGS_PLANES,
    ),
    "motion-bases": TrainConfig(
        model=ModelConfig(sh_degree=2, layers=("bases",), embedding_dim=0, eps2d=0.15),
        steps=40_000,
        batch_size=2,
        static_fraction=0.05,
        window_start_widths=(0.03, 0.12),
        window_full_fraction=0.8,
        eps2d_init=0.3,
        ema_steps=1_000,
        max_gaussians=18_000,
        grow_grad2d=8e-4,
        refine_stop_fraction=0.75,
        means_lr_final=5e-5,
        spline_lr_final=3e-4,
        skinning_lr_final=6e-3,
        mse_fraction=0.8,
        pooled_l1_weight=1.0,
    ),
    "static": TrainConfig(
        model=replace(TrainConfig().model, layers=(), embedding_dim=0),
        static_fraction=0.0,
        window_full_fraction=0.0,
    ),
}
"""The settings of each preset."""


def preset(name: str) -> TrainConfig:
    """The settings of one preset. Raises `InvalidInput` for a name that isn't one."""
    if name not in PRESETS:
        raise InvalidInput("preset", f"one of {', '.join(PRESETS)}", name)
    return PRESETS[name]

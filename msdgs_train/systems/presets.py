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
    init_count=100_000,
    max_gaussians=150_000,
    warmup_fraction=3_000 / 40_000,
    sh_interval=1_000,
    field_rate_start=8e-4,
    field_rate_end=1.6e-6,
    densify_gradient=2e-4,
    densify_until_fraction=15_000 / 40_000,
    opacity_reset_every=3_000,
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
        grids_rate_start=8e-3,
        grids_rate_end=8e-5,
    ),
    "deformgs": replace(
        _FIELD,
        model=ModelConfig(layers=("mlp",), depth=8, skip=5, weights=False, embedding_size=0, delta_space="activated"),
    ),
    "4dgs": replace(
        _FIELD,
        model=ModelConfig(
            layers=("plane",),
            plane_channels=32,
            plane_space_nodes=64,
            plane_time_nodes=75,
            plane_width=64,
            plane_scales=(1, 2),
            weights=False,
            embedding_size=0,
            detach_means=False,
        ),
        steps=23_000,
        background="white",
        init_count=2_000,
        warmup_fraction=3_000 / 23_000,
        densify_until_fraction=15_000 / 23_000,
        field_rate_start=1.6e-4 * _4DGS_EXTENT,
        field_rate_end=1.6e-6 * _4DGS_EXTENT,
        grids_rate_start=1.6e-3 * _4DGS_EXTENT,
        grids_rate_end=1.6e-5 * _4DGS_EXTENT,
        l1_weight=1.0,
        plane_bends_weight=1e-2 * _4DGS_PLANES,
        plane_slopes_weight=0.0,
        plane_space_bends_weight=1e-4 * _4DGS_PLANES,
        plane_time_l1_weight=1e-4 * _4DGS_PLANES,
    ),
    "msdgs-bases": TrainConfig(
        model=ModelConfig(sh_degree=2, layers=("bases",), embedding_size=0, eps2d=0.15),
        steps=40_000,
        photographs=2,
        warmup_fraction=0.05,
        window_starts=(0.03, 0.12),
        window_until_fraction=0.8,
        eps2d_start=0.3,
        average_steps=1_000,
        max_gaussians=18_000,
        densify_gradient=8e-4,
        densify_until_fraction=0.75,
        means_rate_end=5e-5,
        bases_rate_end=3e-4,
        basis_logits_rate_end=6e-3,
        squares_part=0.8,
        blocks_weight=1.0,
    ),
    "static": TrainConfig(
        model=replace(TrainConfig().model, layers=(), embedding_size=0),
        warmup_fraction=0.0,
        window_until_fraction=0.0,
    ),
}
"""The settings of each preset."""


def preset(name: str) -> TrainConfig:
    """The settings of one preset. Raises `InvalidInput` for a name that isn't one."""
    if name not in PRESETS:
        raise InvalidInput("preset", f"one of {', '.join(PRESETS)}", name)
    return PRESETS[name]

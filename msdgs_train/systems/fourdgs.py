"""4DGaussians (Wu et al. 2024): one layer of multi-resolution planes over space and time."""

from msdgs_train.gaussians.config import ModelConfig
from msdgs_train.layers.plane import PlaneConfig
from msdgs_train.supports.gaussians import GaussiansConfig
from msdgs_train.systems.deformgs import PUBLISHED
from msdgs_train.systems.registry import register_system

SCENE_SCALE = 5.0  # scene units; 4DGS multiplies its learning rates by it
NUM_PLANES = 3  # 4DGS sums the smoothness of three planes, where this project takes the mean

FOURDGS = PUBLISHED.updated(
    model=ModelConfig(
        support=GaussiansConfig(detach_deform_input=False),
        layers=(
            PlaneConfig(
                features=32,
                resolution=64,
                time_resolution=75,
                width=64,
                multires=(1, 2),
                lr_init=1.6e-4 * SCENE_SCALE,
                lr_final=1.6e-6 * SCENE_SCALE,
                grid_lr_init=1.6e-3 * SCENE_SCALE,
                grid_lr_final=1.6e-5 * SCENE_SCALE,
                time_smoothness_weight=1e-2 * NUM_PLANES,
                l1_time_planes_weight=1e-4 * NUM_PLANES,
                plane_tv_weight=0.0,
                plane_smoothness_weight=1e-4 * NUM_PLANES,
            ),
        ),
        weights=False,
        embedding_dim=0,
    ),
    steps=23_000,
    background="white",
    init_num_pts=2_000,
    static_fraction=3_000 / 23_000,  # its coarse stage
    sh_degree_fraction=1_000 / 23_000,
    refine_start_fraction=500 / 23_000,
    refine_stop_fraction=15_000 / 23_000,
    refine_every_fraction=100 / 23_000,
    reset_every_fraction=3_000 / 23_000,
    ssim_lambda=0.0,
)
register_system("4dgs", "4DGaussians", FOURDGS)

"""Motion bases: control nodes on splines that carry the Gaussians (after Shape of Motion, Wang et al. 2024)."""

from msdgs_train.engine.config import TrainConfig
from msdgs_train.gaussians.config import ModelConfig
from msdgs_train.layers.spline import SplineConfig
from msdgs_train.supports.nodes import NodesConfig
from msdgs_train.systems.registry import register_system

register_system(
    "motion-bases",
    "256 control nodes on splines carry the Gaussians",
    TrainConfig().updated(
        model=ModelConfig(
            sh_degree=2,
            support=NodesConfig(skinning_lr_final=6e-3),
            layers=(SplineConfig(lr_final=3e-4),),
            embedding_dim=0,
            eps2d=0.15,
        ),
        steps=40_000,
        batch_size=2,
        static_fraction=0.05,
        window_start_widths=(0.03, 0.12),
        window_full_fraction=0.8,
        eps2d_init=0.3,
        ema_fraction=1_000 / 40_000,
        sh_degree_fraction=2_000 / 40_000,
        refine_start_fraction=500 / 40_000,
        refine_every_fraction=100 / 40_000,
        max_gaussians=18_000,
        grow_grad2d=8e-4,
        refine_stop_fraction=0.75,
        means_lr_final=5e-5,
        mse_fraction=0.8,
        pooled_l1_weight=1.0,
    ),
)

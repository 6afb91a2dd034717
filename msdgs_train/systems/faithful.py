"""The published loops, for comparisons with published figures: presets beside those that are made for CPUs.

Constants of Deformable-3D-Gaussians (ac42372) and 4DGaussians (843d5ac) for D-NeRF: arguments/, train.py and scene/.
The paper names neither initialization nor loop of its systems; its layers are trained here by that of
Deformable-3D-Gaussians, on which it builds.
"""

from dataclasses import replace

from msdgs_serve.rasterizer import INRIA
from msdgs_train.engine.config import TrainConfig
from msdgs_train.gaussians.config import ModelConfig
from msdgs_train.layers.mlp import MLPConfig
from msdgs_train.layers.plane import PlaneConfig
from msdgs_train.systems.deformgs import NO_CAP, PUBLISHED
from msdgs_train.systems.fourdgs import FOURDGS
from msdgs_train.systems.msdgs import PAPER_LAYERS
from msdgs_train.systems.registry import register_system

PLANE_POINTS = 50_000
"""Table 4's modulation has 1.69 M parameters with planes and 3.41 M with MLPs, 52,776 and 106,526 Gaussians; those with
MLPs start as 100,000."""
NEVER = 1e6  # times the scene's scale: 4DGaussians prunes once, at step 8,000 of its second stage, above 200,000


def published(config: TrainConfig, model: ModelConfig) -> TrainConfig:
    """What these loops have in common: no growing window, no clip, gray Gaussians at the start, INRIA's rasterizer;
    rounds of density control are after step 500 and before 15,000."""
    steps = config.run.steps
    return config.updated(
        model=replace(model, near_plane=INRIA.near_plane, alpha_max=INRIA.alpha_max),
        window_full_fraction=0.0,
        gradient_clip=None,
        init_gray=0.5,
        refine_start_fraction=501 / steps,
        refine_stop_fraction=14_999 / steps,
    )


def _deformgs(model: ModelConfig) -> TrainConfig:
    return published(PUBLISHED, replace(model, scale_space="linear")).updated(
        static_fraction=2_999 / 40_000,
        means_lr_until_fraction=30_000 / 40_000,
        max_gaussians=NO_CAP,
        absolute_gradients=True,
        grow_grad2d=7e-4,
    )


_MLP = MLPConfig(initialization="torch", lr_init=8e-4, lr_final=1.6e-6)
_PLANE = PlaneConfig(
    initialization="xavier", lr_init=8e-4, lr_final=1.6e-6, grid_lr_init=8e-3, grid_lr_final=8e-5,
    time_smoothness_weight=0.0, plane_tv_weight=0.0, tv_weight=1e-4,
)  # fmt: skip

register_system(
    "deformgs-faithful",
    "Deformable-3D-Gaussians with its own loop",
    _deformgs(
        ModelConfig(layers=(replace(_MLP, depth=8, skip=5),), weights=False, embedding_dim=0, quat_space="raw"),
    ),
)
register_system(
    "msdgs-mlp-faithful",
    "the paper's 10 MLP layers in the loop of Deformable-3D-Gaussians",
    _deformgs(ModelConfig(layers=(_MLP,) * PAPER_LAYERS)),
)
register_system(
    "msdgs-plane-faithful",
    "the paper's 10 plane layers in the loop of Deformable-3D-Gaussians",
    _deformgs(ModelConfig(layers=(_PLANE,) * PAPER_LAYERS)).updated(init_num_pts=PLANE_POINTS),
)

_GRIDS = FOURDGS.model.layers[0]
assert isinstance(_GRIDS, PlaneConfig)
register_system(
    "4dgs-faithful",
    "4DGaussians with its own loop of two stages",
    published(
        FOURDGS, replace(FOURDGS.model, layers=(replace(_GRIDS, initialization="xavier", smooths_one_axis=True),))
    ).updated(restart_at_motion=True, max_gaussians=360_000, prune_opa=0.0, prune_scale3d=NEVER),
)

"""Motion bases: control nodes on splines that carry the Gaussians (after Shape of Motion, Wang et al. 2024)."""

from msdgs_train.layers.spline import SplineConfig
from msdgs_train.systems.control_nodes import ON_NODES
from msdgs_train.systems.registry import register_system

register_system(
    "motion-bases",
    "256 control nodes on splines carry the Gaussians",
    ON_NODES.updated(
        layers=(SplineConfig(lr_final=3e-4),),
        steps=40_000,
        batch_size=2,
        window_start_widths=(0.03, 0.12),
        window_full_fraction=0.8,
        pooled_l1_weight=1.0,
    ),
)

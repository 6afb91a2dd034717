"""A pruned model as a scene: its moving part baked as any model is, the static Gaussians stored after it."""

from dataclasses import replace

import numpy as np

from export.jobs.bake import Baked, bake
from export.pruning.mask import PrunedModel
from msdgs_train.gaussians.model_file import SceneInfo


def bake_pruned(pruned: PrunedModel, info: SceneInfo, checkpoint_sha256: str) -> Baked:
    """All that a plan needs to write the scene file of a pruned model."""
    baked = bake(pruned.moving, info, checkpoint_sha256)
    scene, static = baked.scene, pruned.static
    scene = replace(
        scene,
        metadata=replace(scene.metadata, left_out=pruned.left_out),
        static_means=np.concatenate([scene.static_means, static.means]),
        static_quats=np.concatenate([scene.static_quats, static.quats]),
        static_scales=np.concatenate([scene.static_scales, static.scales]),
        opacities=np.concatenate([scene.opacities, static.opacities]),
        sh=np.concatenate([scene.sh, static.sh]),
    )
    return replace(baked, scene=scene.validate("the pruned scene"))

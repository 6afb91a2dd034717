"""A trimmed model as a scene: its moving part baked as any model is, the still Gaussians stored after it."""

from dataclasses import replace

import numpy as np

from export.jobs.bake import Baked, bake
from export.pruning.mask import TrimmedModel
from msdgs_train.gaussians.model_file import SceneInfo


def bake_trimmed(trimmed: TrimmedModel, info: SceneInfo, checkpoint_sha256: str) -> Baked:
    """All that a plan needs to write the scene file of a trimmed model."""
    baked = bake(trimmed.moving, info, checkpoint_sha256)
    scene, still = baked.scene, trimmed.still
    scene = replace(
        scene,
        metadata=replace(scene.metadata, left_out=trimmed.left_out),
        static_means=np.concatenate([scene.static_means, still.means]),
        static_quats=np.concatenate([scene.static_quats, still.quats]),
        static_scales=np.concatenate([scene.static_scales, still.scales]),
        opacities=np.concatenate([scene.opacities, still.opacities]),
        sh=np.concatenate([scene.sh, still.sh]),
    )
    return replace(baked, scene=scene.validate("the trimmed scene"))

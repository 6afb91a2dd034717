"""Baking: the constants of a scene file, computed from a trained model in float32."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from msdgs_export.layers.graph import to_numpy
from msdgs_serve import __version__
from msdgs_serve.rasterizer import GSPLAT
from msdgs_serve.scene.baked import CONTRACT, BakedScene, SceneCamera, SceneMetadata
from msdgs_serve.scene.gaussians import FloatArray
from msdgs_train.gaussians.model import DynamicGaussians, canonical_points
from msdgs_train.gaussians.model_file import SceneInfo
from msdgs_train.gaussians.modulation import EMBEDDINGS
from msdgs_train.gaussians.raw_quaternions import QuatSpace
from msdgs_train.gaussians.scale_space import ScaleSpace
from msdgs_train.layers.arrays import to_array
from msdgs_train.layers.base import DeformationLayer
from msdgs_train.supports.base import Support
from msdgs_train.supports.gaussians import GaussiansConfig

STARTING_CAMERAS = 8
"""Cameras stored in a scene file, evenly spread over the model's."""


DELTA_SPACES: dict[ScaleSpace, str] = {"log": "raw", "linear": "activated"}
"""Names of scale spaces in scene files."""


@dataclass(frozen=True)
class Moving:
    """The Gaussians that a graph deforms, in storage space; float32, rows in the order of the ids."""

    means: FloatArray  # [M, 3]
    log_scales: FloatArray  # [M, 3]
    quats: FloatArray  # [M, 4] wxyz, unit
    raw_quats: FloatArray  # [M, 4] wxyz, of any norm
    modulation: dict[str, FloatArray] = field(default_factory=dict)
    """By head: factors of its deltas (equation 12), [M, 3] or [M, 4]."""
    appearance: dict[str, FloatArray] = field(default_factory=dict)
    """What is changing: logits of `opacities`, [M, 1], and `sh`, [M, C, 3]."""
    attributes: dict[str, np.ndarray] = field(default_factory=dict)  # stored by the support per Gaussian
    baked_attributes: dict[str, np.ndarray] = field(default_factory=dict)  # as a graph reads it: `Support.baked`

    @classmethod
    def none(cls) -> "Moving":
        """No Gaussians."""
        three, four = np.empty((0, 3), np.float32), np.empty((0, 4), np.float32)
        return cls(three, three, four, four)

    def __len__(self) -> int:
        return len(self.means)


@dataclass(frozen=True)
class Baked:
    """The input of a plan: everything that a scene file stores."""

    scene: BakedScene
    moving: Moving
    layers: tuple[DeformationLayer, ...]  # float32; empty if nothing moves
    support: Support = field(default_factory=lambda: GaussiansConfig().build())
    quat_space: QuatSpace = "unit"


def bake(model: DynamicGaussians, info: SceneInfo, checkpoint_sha256: str) -> Baked:
    """Evaluate everything that doesn't depend on time in float32. The model isn't changed.

    Without deformation layers, or without Gaussians, the whole scene is static. Raises `ModelNotExportable`.
    """
    with torch.no_grad():
        canonical = model.pose(info.time_range[0], deform=False)
        moves = bool(len(model.deformation)) and len(model.gaussians) > 0
        moving = _moving(model) if moves else Moving.none()
    layers = tuple(model.deformation) if moves else ()
    kinds = tuple(layer.kind for layer in layers)
    appearance = {"opacities": to_numpy(canonical.opacities), "sh": to_numpy(canonical.sh)}
    scene = BakedScene(
        _metadata(model, info, kinds, checkpoint_sha256),
        moving_count=len(moving),
        static_means=to_numpy(canonical.means[len(moving) :]),
        static_quats=to_numpy(canonical.quats[len(moving) :]),
        static_scales=to_numpy(canonical.scales[len(moving) :]),
        **{name: values[len(moving) if name in moving.appearance else 0 :] for name, values in appearance.items()},
        changing=tuple(moving.appearance),
    )
    return Baked(scene.validate("the baked scene"), moving, layers, model.support, model.config.quat_space)


def _moving(model: DynamicGaussians) -> Moving:
    g = model.gaussians
    points = canonical_points(g.rows())
    stored = {name: values for name, values in g.attributes.items() if name != EMBEDDINGS}
    factors = {} if model.modulation is None else model.modulation(g.attributes[EMBEDDINGS])
    appearance = {"opacities": g.raw_opacities[:, None], "sh": torch.cat([g.sh_dc, g.sh_rest], dim=1)}
    return Moving(
        to_numpy(g.means),
        to_numpy(g.log_scales),
        to_numpy(points.quats),
        to_numpy(points.raw_quats),
        {head: to_numpy(values) for head, values in factors.items()},
        {name: to_numpy(appearance[name]) for name in changing_outputs(model)},
        {name: to_array(values) for name, values in stored.items()},
        model.support.baked(points),
    )


def _metadata(
    model: DynamicGaussians, info: SceneInfo, layers: tuple[str, ...], checkpoint_sha256: str
) -> SceneMetadata:
    draft = SceneMetadata(
        contract=CONTRACT,
        layers=layers,
        plan="network",
        time_range=(float(info.time_range[0]), float(info.time_range[1])),
        bounds=(tuple(info.bounds[0]), tuple(info.bounds[1])),
        sh_degree=model.config.sh_degree,
        delta_space=DELTA_SPACES[model.config.scale_space],
        background=info.background,
        antialiasing="dilate",
        cameras=starting_cameras(info),
        left_out=limits_left_out(model, len(model.gaussians)),
        measured_error={},
        package_version=__version__,
        checkpoint_sha256=checkpoint_sha256,
        eps2d=float(model.config.eps2d),
        scene_to_world=info.placement,
    )
    # through the reader of scene files, which refuses invalid values
    return SceneMetadata.from_properties(draft.to_properties(), "the model's scene")


def limits_left_out(model: DynamicGaussians, count: int) -> tuple[dict[str, Any], ...]:
    """Limits of the rasterizer that a model of so many Gaussians was trained with, which scene files don't hold."""
    trained = model.rasterizer
    if (trained.near_plane, trained.alpha_max) == (GSPLAT.near_plane, GSPLAT.alpha_max):
        return ()
    what = (
        f"near plane {trained.near_plane:g} and largest alpha {trained.alpha_max:g} of training, "
        f"where readers have {GSPLAT.near_plane:g} and {GSPLAT.alpha_max:g}"
    )
    return ({"rule": "rasterizer", "what": what, "count": count, "of": count},)


def starting_cameras(info: SceneInfo) -> tuple[SceneCamera, ...]:
    """Up to eight of the model's cameras, evenly spread, including the first and the last."""
    chosen = np.linspace(0, len(info.cameras) - 1, min(STARTING_CAMERAS, len(info.cameras))).round().astype(int)
    return tuple(SceneCamera.from_plain(info.cameras[i]) for i in chosen)


def changing_outputs(model: DynamicGaussians, shading: bool = True) -> tuple[str, ...]:
    """Those of opacities and SH that depend on time, by heads and by shading, which pruning may remove."""
    shades = shading and any(layer.shades for layer in model.deformation)
    heads = {"opacities": model.config.opacity_head, "sh": model.config.sh_head or shades}
    return tuple(name for name, is_on in heads.items() if is_on and len(model.deformation))

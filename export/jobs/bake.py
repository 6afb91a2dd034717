"""From a trained model to what a scene file stores: constants computed once, what only training needs left behind."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch

from msdgs_serve import __version__
from msdgs_serve.scene.baked import CONTRACT, BakedScene, SceneCamera, SceneMetadata
from msdgs_serve.scene.errors import InvalidInput, MsdgsError
from msdgs_serve.scene.gaussians import FloatArray
from msdgs_train.gaussians.model import DynamicGaussians, carried, unit_quats
from msdgs_train.gaussians.model_file import SceneInfo
from msdgs_train.layers.mlp import MLPLayer
from msdgs_train.layers.plane import PlaneLayer
from msdgs_train.supports.nodes import BasisLayer

STARTING_CAMERAS = 8
"""Cameras kept in a scene file, evenly spread over those of the training."""


class ModelNotExportable(MsdgsError):
    """A model has values or parts that a scene file can't hold."""


Layer = MLPLayer | PlaneLayer | BasisLayer


@dataclass(frozen=True)
class Moving:
    """The Gaussians that a graph deforms, in storage space; float32, rows in the order of the ids."""

    means: FloatArray  # [M, 3]
    log_scales: FloatArray  # [M, 3]
    quats: FloatArray  # [M, 4] wxyz, unit
    scale_modulation: FloatArray | None  # [M, 3] factors of equation 12; None where the model has none
    mean_modulation: FloatArray | None = None  # [M, 3]
    quat_modulation: FloatArray | None = None  # [M, 4]
    skinning_weights: FloatArray | None = None  # [M, F] of motion bases that each follows, rows sum to 1; None: none
    node_ids: npt.NDArray[np.int64] | None = None  # [M, F] which ones these are

    def __len__(self) -> int:
        return len(self.means)


@dataclass(frozen=True)
class Baked:
    """All that a plan needs to write a scene file."""

    scene: BakedScene
    moving: Moving
    layers: tuple[Layer, ...]  # float32; empty where nothing moves


def bake(model: DynamicGaussians, info: SceneInfo, checkpoint_sha256: str) -> Baked:
    """Everything that doesn't depend on time, evaluated in float32. The model isn't changed.

    Without deformation layers, or without Gaussians, all of the scene is static. Raises `ModelNotExportable` naming
    what `msdgs/1` has no place for.
    """
    _refuse_heads(model)
    with torch.no_grad():
        canonical = model.pose(info.time_range[0], deform=False)
        moves = bool(len(model.deformation)) and len(model.gaussians) > 0
        moving = _moving(model) if moves else _nothing_moving()
    layers = tuple(_checked_layer(layer) for layer in model.deformation.layers) if moves else ()
    scene = BakedScene(
        _metadata(model, info, tuple(layer.kind for layer in layers), checkpoint_sha256),
        moving_count=len(moving),
        static_means=_array(canonical.means[len(moving) :]),
        static_quats=_array(canonical.quats[len(moving) :]),
        static_scales=_array(canonical.scales[len(moving) :]),
        opacities=_array(canonical.opacities),
        sh=_array(canonical.sh),
    )
    return Baked(scene.validate("the baked scene"), moving, layers)


def _moving(model: DynamicGaussians) -> Moving:
    g, followed = model.gaussians, carried(model.gaussians)
    factors = {"means": None, "scales": None, "quats": None}
    if model.modulation is not None:
        factors |= {name: _array(values) for name, values in model.modulation(g.embeddings).present().items()}
    return Moving(
        _array(g.means),
        _array(g.log_scales),
        _array(unit_quats(g.raw_quats)),
        scale_modulation=factors["scales"],
        mean_modulation=factors["means"],
        quat_modulation=factors["quats"],
        skinning_weights=None if followed is None else _array(followed.skinning_weights),
        node_ids=None if followed is None else followed.node_ids.numpy(),
    )


def _nothing_moving() -> Moving:
    three = np.empty((0, 3), np.float32)
    return Moving(three, three, np.empty((0, 4), np.float32), None)


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
        delta_space=model.config.delta_space,
        background=info.background,
        antialiasing="dilate",
        cameras=starting_cameras(info),
        left_out=(),
        measured_error={},
        package_version=__version__,
        checkpoint_sha256=checkpoint_sha256,
        eps2d=float(model.config.eps2d),
    )
    # through its own reader: what a later reader would refuse is refused here
    return SceneMetadata.from_properties(draft.to_properties(), "the model's scene")


def starting_cameras(info: SceneInfo) -> tuple[SceneCamera, ...]:
    """At most eight of the training's cameras, evenly spread, the first and the last among them."""
    chosen = np.linspace(0, len(info.cameras) - 1, min(STARTING_CAMERAS, len(info.cameras))).round().astype(int)
    try:
        return tuple(SceneCamera.from_plain(info.cameras[i]) for i in chosen)
    except (InvalidInput, ValueError, KeyError, TypeError) as error:
        raise ModelNotExportable(f"a camera of the model's scene can't be used: {error}") from error


def _refuse_heads(model: DynamicGaussians) -> None:
    for option, stored in (("opacity_head", "opacities"), ("sh_head", "sh")):
        if getattr(model.config, option) and len(model.deformation):
            raise ModelNotExportable(
                f"model.{option} is on, so `{stored}` change with time, and {CONTRACT} holds them as constants; "
                "train without that head to export"
            )


def _checked_layer(layer: torch.nn.Module) -> Layer:
    if not isinstance(layer, Layer):
        raise ModelNotExportable(f"a layer of type {type(layer).__name__} has no graph in the plan `network`")
    return layer


def _array(tensor: torch.Tensor) -> FloatArray:
    return np.ascontiguousarray(tensor.detach().to("cpu", torch.float32).numpy())

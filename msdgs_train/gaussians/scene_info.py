"""What a model file says of its scene."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from msdgs_serve.scene.errors import MsdgsError
from msdgs_serve.scene.metadata import SceneCamera
from msdgs_serve.scene.similarity import IDENTITY, Similarity
from msdgs_train.datasets import SceneData
from msdgs_train.datasets.common.times import EXPECTED, is_time_from
from msdgs_train.datasets.config import DataConfig
from msdgs_train.gaussians.bounds import first_by_pose, spread_frames
from msdgs_train.gaussians.safe_load import CheckpointInvalid

VIEWER_CAMERAS, TRAINING_CAMERAS = 20, 32
"""Cameras that a model file keeps: of the test split, or of training if there is none, and others of training."""


@dataclass(frozen=True)
class SceneInfo:
    """Time range, background, bounds and cameras of a model's scene; plain values only."""

    time_range: tuple[float, float] = (0.0, 1.0)
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)  # sRGB in [0, 1], as evaluated
    bounds: list[list[float]] = field(default_factory=lambda: [[-1.0] * 3, [1.0] * 3])  # corners, scene units
    cameras: list[dict[str, Any]] = field(default_factory=list)
    """Those of the viewer. Each has name, fx, fy, cx, cy (pixels), width, height, camera_to_world (4×4 nested lists,
    OpenCV) and t."""
    training_cameras: list[dict[str, Any]] = field(default_factory=list)
    """Others, of training images, from which export also measures errors."""
    size: int | None = None
    """Width in pixels to which images were reduced, as in `DataConfig`."""
    llffhold: int = 0
    """Every so many images were held out, as in `DataConfig`."""
    time_from: str | None = None
    """Where times came from, as in `DataConfig`."""
    masks: bool = True
    """Whether masks hid pixels, as in `DataConfig`."""
    scene_to_world: dict[str, Any] = field(default_factory=IDENTITY.to_plain)
    """Plain values of the `Similarity` from the frame of the model, bounds and cameras to the user's world."""

    @property
    def placement(self) -> Similarity:
        """`scene_to_world` as a `Similarity`."""
        return Similarity.from_plain(self.scene_to_world)

    @classmethod
    def of_run(cls, scene: SceneData, data: DataConfig, bounds: list[list[float]]) -> "SceneInfo":
        """That of a model which was trained on a scene with these settings; `bounds` are corners."""
        training = scene.splits["train"]
        shown = spread_frames(scene.splits.get("test") or training, VIEWER_CAMERAS)
        others = first_by_pose([*shown, *spread_frames(training, TRAINING_CAMERAS)], lambda frame: frame.camera)
        return cls(
            time_range=scene.time_range,
            background=data.evaluation_background(scene),
            bounds=bounds,
            cameras=[SceneCamera(f.name, f.t, f.camera).to_plain() for f in shown],
            training_cameras=[SceneCamera(f.name, f.t, f.camera).to_plain() for f in others[len(shown) :]],
            size=data.size,
            llffhold=data.llffhold,
            scene_to_world=scene.scene_to_world.to_plain(),
            time_from=data.time_from,
            masks=data.masks,
        )


def refuse_unusable_scene(path: str | Path, scene: SceneInfo) -> None:
    """Raise `CheckpointInvalid` naming a value that can't be used."""
    for name in ("cameras", "training_cameras"):
        try:
            for camera in getattr(scene, name):
                SceneCamera.from_plain(camera)
        except (LookupError, TypeError, ValueError, MsdgsError) as error:
            raise CheckpointInvalid(path, f"scene.{name} holds a camera that can't be used: {error}") from error
    try:
        scene.placement  # noqa: B018
    except (LookupError, TypeError, ValueError, MsdgsError) as error:
        raise CheckpointInvalid(path, f"scene.scene_to_world can't be used: {error}") from error
    for name in ("size", "llffhold"):
        value = getattr(scene, name)
        if type(value) is not int and (name, value) != ("size", None):
            raise CheckpointInvalid(path, f"scene.{name} must be a whole number, got {value!r}")
    if not is_time_from(scene.time_from):
        raise CheckpointInvalid(path, f"scene.time_from must be {EXPECTED}, got {scene.time_from!r}")
    for name, shape in (("time_range", (2,)), ("background", (3,)), ("bounds", (2, 3))):
        try:
            values = torch.tensor(getattr(scene, name), dtype=torch.float64)
        except (TypeError, ValueError, RuntimeError):
            values = torch.empty(0)
        if values.shape != shape or not torch.isfinite(values).all():
            expected = " × ".join(map(str, shape))
            raise CheckpointInvalid(path, f"scene.{name} must be {expected} finite numbers, got {getattr(scene, name)}")

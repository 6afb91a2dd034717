"""`model.pt` of volumes."""

from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from msdgs_serve.scene import Camera
from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.datasets.rays import rays_of
from msdgs_train.gaussians.scene_info import SceneInfo
from msdgs_train.gaussians.stored import ParameterCounts, register_format, save_stored
from msdgs_train.settings import OWN_SETTINGS
from msdgs_train.volumes.config import VolumeConfig
from msdgs_train.volumes.field import RayField
from msdgs_train.volumes.march import march
from msdgs_train.volumes.space import Box

FORMAT = "msdgs-volume/1"
CHUNK = 512  # rays that are rendered at once; 1.2 to 1.4 times as fast as 4,096, whose samples exceed the caches


class StoredVolume(NamedTuple):
    """The contents of `model.pt`."""

    system: str
    model: RayField
    scene: SceneInfo
    step: int

    @property
    def description(self) -> str:
        return f"a volume that rays are marched through (system {self.system})"

    @property
    def size(self) -> int:
        """Number of vertices of its grid in space."""
        return self.model.size

    @property
    def parameter_counts(self) -> ParameterCounts:
        return ParameterCounts(sum(p.numel() for p in self.model.parameters()), 0)

    def render(self, camera: Camera, t: float) -> Tensor:
        """Return [H, W, 3] over the scene's background."""
        return render(self.model, camera, t, torch.tensor(self.scene.background))


@torch.no_grad()
def render(field: RayField, camera: Camera, t: float, background: Tensor) -> Tensor:
    """Render [H, W, 3] over `background`, [3]."""
    rays = rays_of(camera, t, str(background.device))
    colors = [march(field, part, background).rgb for part in rays.split(CHUNK)]
    return torch.cat(colors).view(camera.height, camera.width, 3)


def save_volume(path: Path, system: str, field: RayField, config: VolumeConfig, scene: SceneInfo, step: int) -> None:
    """Write `model.pt`, atomically."""
    save_stored(path, {"format": FORMAT, "system": system, "config": asdict(config)}, field, scene, step)


def _read(path: Path, contents: dict[str, Any], scene: SceneInfo) -> StoredVolume:
    system, state = contents["system"], contents["state"]
    kind = OWN_SETTINGS.get(system)
    if kind is None or not issubclass(kind, VolumeConfig):
        raise InvalidInput("system", "that of a volume; others come with --plugin MODULE", system)
    config = kind(**contents["config"])
    low, high = state["corners"]
    if low.shape != (3,) or not bool((low < high).all()):
        raise InvalidInput("corners", "2 × 3 numbers, the lower ones first", tuple(state["corners"].shape))
    with torch.device("meta"):  # sizes that disagree with the stored tensors take no memory
        field = config.build(Box(low, high))
    field.load_grown({name: tensor.to(_type(name)) for name, tensor in state.items()}, assign=True)
    return StoredVolume(system, field, scene, int(contents["step"]))


def _type(name: str) -> torch.dtype:
    return torch.bool if name == "cells" else torch.float32


register_format(FORMAT, _read)

"""`model.pt`: a trained model, which `eval`, `view` and the export read."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from msdgs_serve.scene.camera import Camera
from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.gaussians.canonical import CanonicalGaussians
from msdgs_train.gaussians.config import ModelConfig
from msdgs_train.gaussians.model import DynamicGaussians
from msdgs_train.gaussians.modulation import EMBEDDINGS
from msdgs_train.gaussians.safe_load import CheckpointInvalid
from msdgs_train.gaussians.scene_info import SceneInfo
from msdgs_train.gaussians.stored import ParameterCounts, load_stored, register_format, save_stored
from msdgs_train.rendering.rasterize import rasterize

FORMAT = "msdgs-model/2"


class LoadedModel(NamedTuple):
    """The contents of `model.pt`."""

    model: DynamicGaussians
    scene: SceneInfo
    step: int

    @property
    def description(self) -> str:
        return "Gaussians"

    @property
    def size(self) -> int:
        """Number of Gaussians."""
        return len(self.model.gaussians)

    @property
    def parameter_counts(self) -> ParameterCounts:
        modulation = self.model.modulation
        own = 0 if modulation is None else sum(p.numel() for p in modulation.parameters())
        embeddings = 0 if modulation is None else self.model.gaussians.attributes[EMBEDDINGS].numel()
        layers = (*self.model.deformation.parameters(), *self.model.support.parameters())
        return ParameterCounts(sum(p.numel() for p in layers if p.requires_grad), own + embeddings)

    @torch.no_grad()
    def render(self, camera: Camera, t: float, num_layers: int | None = None) -> Tensor:
        """Return [H, W, 3] over the scene's background, after the first `num_layers` layers; all if not given."""
        background = torch.tensor(self.scene.background)
        return rasterize(*self.model.pose(t, num_layers=num_layers), camera, background, self.model.rasterizer)[0]


def save_model(
    path: str | Path, model: DynamicGaussians, scene: SceneInfo, step: int, config: ModelConfig | None = None
) -> None:
    """Write `model.pt`, atomically. `config`, if given, replaces the model's own: another eps2d, for example."""
    contents = {"format": FORMAT, "config": (config or model.config).to_dict()}
    save_stored(path, contents, model, scene, step)


def load_model(path: str | Path) -> LoadedModel:
    """Read the `model.pt` of Gaussians onto the CPU. Raises `CheckpointInvalid` for any file that isn't a whole, finite
    model of them."""
    stored = load_stored(path)
    if not isinstance(stored, LoadedModel):
        problem = f"holds {stored.description}, and no Gaussians, which this needs"
        raise CheckpointInvalid(path, f"{problem}: `msdgs-train eval` and `compare` read it, nothing else does")
    return stored


def _read(path: Path, contents: dict[str, Any], scene: SceneInfo) -> LoadedModel:
    model = _build(ModelConfig.from_dict(contents["config"]), contents["state"])
    return LoadedModel(model, scene, int(contents["step"]))


register_format(FORMAT, _read)


def _build(config: ModelConfig, state: dict[str, Tensor]) -> DynamicGaussians:
    """Build a model from its configuration and tensors. Raises `InvalidInput` naming a missing or unexpected one."""
    prefix = "gaussians."
    gaussians = {name.removeprefix(prefix): tensor for name, tensor in state.items() if name.startswith(prefix)}
    absent = [name for name in CanonicalGaussians.__annotations__ if name not in gaussians]
    if absent:
        raise InvalidInput(prefix + absent[0], "a tensor", None)
    for layer in config.layers:
        layer.check_stored(len(state))
    with torch.device("meta"):  # sizes that disagree with the stored tensors take no memory here
        _check_tensors(DynamicGaussians(config, CanonicalGaussians(**gaussians)).state_dict(), state)
    model = DynamicGaussians(config, CanonicalGaussians(**gaussians))
    model.load_state_dict(state)
    model.support.check_attributes(model.gaussians.attributes)
    return model


def _check_tensors(expected: Mapping[str, Tensor], stored: Mapping[str, Tensor]) -> None:
    for name in {**expected, **stored}:
        wanted, found = (tuple(each[name].shape) if name in each else None for each in (expected, stored))
        if wanted != found:
            raise InvalidInput(name, "absent" if wanted is None else f"a tensor of shape {wanted}", found)

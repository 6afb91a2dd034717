"""`model.pt`: a trained model, which `eval`, `view` and the export read."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from msdgs_serve import __version__
from msdgs_serve.scene.camera import Camera
from msdgs_serve.scene.errors import InvalidInput, MsdgsError
from msdgs_serve.scene.metadata import SceneCamera
from msdgs_serve.scene.similarity import IDENTITY, Similarity
from msdgs_train.datasets.common.times import EXPECTED, is_time_from
from msdgs_train.gaussians.canonical import CanonicalGaussians
from msdgs_train.gaussians.config import ModelConfig
from msdgs_train.gaussians.model import DynamicGaussians
from msdgs_train.gaussians.safe_load import CheckpointInvalid, load, refuse_unlike_stored, save_atomic
from msdgs_train.rendering.rasterize import rasterize

FORMAT = "msdgs-model/2"


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


class LoadedModel(NamedTuple):
    """The contents of `model.pt`."""

    model: DynamicGaussians
    scene: SceneInfo
    step: int

    @torch.no_grad()
    def render(self, camera: Camera, t: float, num_layers: int | None = None) -> Tensor:
        """Return [H, W, 3] over the scene's background, after the first `num_layers` layers; all if not given."""
        background = torch.tensor(self.scene.background)
        return rasterize(*self.model.pose(t, num_layers=num_layers), camera, background, self.model.rasterizer)[0]


def save_model(
    path: str | Path, model: DynamicGaussians, scene: SceneInfo, step: int, config: ModelConfig | None = None
) -> None:
    """Write `model.pt`, atomically. `config`, if given, replaces the model's own: another eps2d, for example."""
    contents = {
        "format": FORMAT,
        "package_version": __version__,
        "config": (config or model.config).to_dict(),
        "scene": asdict(scene),
        "step": step,
        "state": {name: tensor.detach().cpu() for name, tensor in model.state_dict().items()},
    }
    save_atomic(path, contents)


def load_model(path: str | Path) -> LoadedModel:
    """Read `model.pt` onto the CPU. Raises `CheckpointInvalid` for any file that isn't a whole, finite model."""
    contents = load(path)
    if not isinstance(contents, dict) or contents.get("format") != FORMAT:
        found = contents.get("format") if isinstance(contents, dict) else type(contents).__name__
        raise CheckpointInvalid(
            path, f"isn't a model of format {FORMAT} (found {found!r}): train or import it again with this version"
        )
    missing = [name for name in ("config", "scene", "step", "state") if name not in contents]
    if missing:
        raise CheckpointInvalid(path, f"isn't a complete model: `{missing[0]}` is missing")
    try:
        state = contents["state"]
        refuse_unlike_stored(path, state)
        _refuse_not_finite(path, state)
        model = _build(ModelConfig.from_dict(contents["config"]), state)
        scene = SceneInfo(**contents["scene"])
        _refuse_unusable_scene(path, scene)
        return LoadedModel(model, scene, int(contents["step"]))
    except (ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RuntimeError) as error:
        problem = f": {error}" if isinstance(error, MsdgsError) else ", or one of another version"
        raise CheckpointInvalid(path, f"isn't a complete model{problem}") from error


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


def _refuse_not_finite(path: str | Path, state: dict[str, Tensor]) -> None:
    # compared as float32: a finite float64 may be infinite in it
    counts = {name: int((~torch.isfinite(tensor.to(torch.float32))).sum()) for name, tensor in state.items()}
    bad = [f"{name} ({count:,} of {state[name].numel():,})" for name, count in counts.items() if count]
    if bad:
        raise CheckpointInvalid(path, f"holds values that are NaN or infinite: {', '.join(bad)}")


def _refuse_unusable_scene(path: str | Path, scene: SceneInfo) -> None:
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

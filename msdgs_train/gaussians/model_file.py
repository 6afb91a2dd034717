"""Files of a training: `model.pt`, which export reads, and the trainer's own to resume from.

Every file is written beside its place and moved over it, so that a reader finds the old one or the new one whole.
"""

import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from msdgs_serve import __version__
from msdgs_serve.scene.camera import Camera
from msdgs_serve.scene.errors import InvalidInput, MsdgsError
from msdgs_train.engine.files import replacing
from msdgs_train.gaussians.canonical import CanonicalGaussians
from msdgs_train.gaussians.model import DynamicGaussians, ModelConfig
from msdgs_train.rendering.rasterize import rasterize

FORMAT = "msdgs-model/1"

PLAIN = {torch.float16, torch.bfloat16, torch.float32, torch.float64, torch.bool}
PLAIN |= {torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64}
"""Types of numbers."""


class CheckpointInvalid(MsdgsError):
    """A checkpoint can't be read, or holds what no model can use."""

    def __init__(self, file: str | Path, problem: str) -> None:
        super().__init__(f"{file}: {problem}")


@dataclass(frozen=True)
class SceneInfo:
    """What a model's scene is, besides its Gaussians; plain values only."""

    time_range: tuple[float, float] = (0.0, 1.0)
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)  # sRGB in [0, 1], as trained
    bounds: list[list[float]] = field(default_factory=lambda: [[-1.0] * 3, [1.0] * 3])  # corners, scene units
    cameras: list[dict[str, Any]] = field(default_factory=list)
    """Each: name, fx, fy, cx, cy (pixels), width, height, camera_to_world (4×4 nested lists, OpenCV), t."""


class LoadedModel(NamedTuple):
    """What `model.pt` holds."""

    model: DynamicGaussians
    scene: SceneInfo
    step: int

    @torch.no_grad()
    def render(self, camera: Camera, t: float, layers: int | None = None) -> Tensor:
        """[H, W, 3] over the scene's background, after so many `layers` of the deformation; all if not given."""
        background = torch.tensor(self.scene.background)
        return rasterize(*self.model.pose(t, steps=layers), camera, background, self.model.rasterizer)[0]


def save_model(path: str | Path, model: DynamicGaussians, scene: SceneInfo, step: int) -> None:
    """Write `model.pt`, atomically."""
    contents = {
        "format": FORMAT,
        "package_version": __version__,
        "config": asdict(model.config),
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
        raise CheckpointInvalid(path, f"isn't a model of format {FORMAT} (found {found!r})")
    try:
        state = contents["state"]
        refuse_unlike_stored(path, state)
        _refuse_not_finite(path, state)
        model = _build(ModelConfig(**contents["config"]), state)
        scene = SceneInfo(**contents["scene"])
        _refuse_unusable_scene(path, scene)
        return LoadedModel(model, scene, int(contents["step"]))
    except (InvalidInput, KeyError, TypeError, AttributeError, RuntimeError) as error:
        raise CheckpointInvalid(path, f"isn't a complete model: {error}") from error


def save_atomic(path: str | Path, obj: Any) -> None:
    """`torch.save`, atomically."""
    with replacing(Path(path)) as temporary, temporary.open("wb") as file:
        torch.save(obj, file)


def load(path: str | Path) -> Any:
    """`torch.load` of tensors and plain values onto the CPU; no code in the file is run."""
    path = Path(path)
    try:
        size = path.stat().st_size
        if size == 0:
            raise CheckpointInvalid(path, "is empty")
        if not zipfile.is_zipfile(path):
            raise CheckpointInvalid(path, f"isn't a torch checkpoint, or is cut off after {size:,} bytes")
        with zipfile.ZipFile(path) as archive:
            unpacked = sum(entry.file_size for entry in archive.infolist())
        if unpacked > size:  # it could unpack to anything
            raise CheckpointInvalid(path, f"is packed: it holds {unpacked:,} bytes; torch.save packs nothing")
        return torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError as error:
        raise CheckpointInvalid(path, "no such file") from error
    except OSError as error:
        raise CheckpointInvalid(path, f"can't be read: {error.strerror or error}") from error
    except CheckpointInvalid:
        raise
    except Exception as error:  # where bits are turned its stack machine stumbles in any way
        raise CheckpointInvalid(path, f"isn't a whole torch checkpoint of plain values: {error}") from error


def refuse_unlike_stored(path: str | Path, tensors: Mapping[str, Tensor]) -> None:
    """Raise `CheckpointInvalid` for what isn't rows of plain numbers, or claims more of a storage than there is of it.

    Strides of 0 make a few stored bytes a tensor of any size.
    """
    claimed: dict[int, int] = {}
    for name, tensor in tensors.items():
        if not _is_plain(tensor):
            raise CheckpointInvalid(path, f"`{name}` isn't a dense tensor of plain numbers")
        storage = tensor.untyped_storage()
        claimed.setdefault(storage.data_ptr(), 0)
        claimed[storage.data_ptr()] += tensor.numel() * tensor.element_size()
        if claimed[storage.data_ptr()] > storage.nbytes():
            problem = f"of shape {tuple(tensor.shape)} isn't stored in full: it shares {storage.nbytes():,} bytes"
            raise CheckpointInvalid(path, f"`{name}` {problem}")


def _is_plain(tensor: Any) -> bool:
    plain = type(tensor) in (Tensor, nn.Parameter) and tensor.layout is torch.strided and not tensor.is_nested
    return plain and tensor.device.type == "cpu" and tensor.dtype in PLAIN


def _build(config: ModelConfig, state: dict[str, Tensor]) -> DynamicGaussians:
    """A model of this configuration and these tensors; RuntimeError names what is missing or too much."""
    prefix = "gaussians."
    gaussians = {name.removeprefix(prefix): tensor for name, tensor in state.items() if name.startswith(prefix)}
    if "mlp" in config.layers and config.depth > len(state):
        raise InvalidInput("model.depth", f"at most {len(state)}, the number of tensors that are stored", config.depth)
    with torch.device("meta"):  # sizes that aren't what is stored may be any, and take no memory here
        DynamicGaussians(config, CanonicalGaussians(**gaussians)).load_state_dict(state, assign=True)
    model = DynamicGaussians(config, CanonicalGaussians(**gaussians))
    model.load_state_dict(state)
    return model


def _refuse_not_finite(path: str | Path, state: dict[str, Tensor]) -> None:
    bad = [f"{name} ({count:,} of {total:,})" for name, count, total in _not_finite(state)]
    if bad:
        raise CheckpointInvalid(path, f"holds values that are NaN or infinite: {', '.join(bad)}")


def _refuse_unusable_scene(path: str | Path, scene: SceneInfo) -> None:
    for name, shape in (("time_range", (2,)), ("background", (3,)), ("bounds", (2, 3))):
        try:
            values = torch.tensor(getattr(scene, name), dtype=torch.float64)
        except (TypeError, ValueError, RuntimeError):
            values = torch.empty(0)
        if values.shape != shape or not torch.isfinite(values).all():
            expected = " × ".join(map(str, shape))
            raise CheckpointInvalid(path, f"scene.{name} must be {expected} finite numbers, got {getattr(scene, name)}")


def _not_finite(state: dict[str, Tensor]) -> Iterator[tuple[str, int, int]]:
    for name, tensor in state.items():
        count = int((~torch.isfinite(tensor.to(torch.float32))).sum())  # of float64 also what float32 can't hold
        if count:
            yield name, count, tensor.numel()

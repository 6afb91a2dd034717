"""Model files of all kinds: `model.pt`, which `eval` and `compare` read whatever it holds."""

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor, nn

from msdgs_serve import __version__
from msdgs_serve.scene import Camera
from msdgs_serve.scene.errors import MsdgsError
from msdgs_train.gaussians.safe_load import CheckpointInvalid, load, refuse_unlike_stored, save_atomic
from msdgs_train.gaussians.scene_info import SceneInfo, refuse_unusable_scene
from msdgs_train.layers.plugins import load_plugins


class ParameterCounts(NamedTuple):
    """Trainable numbers of a model beside canonical Gaussians."""

    motion: int  # of the deformation; of a volume all
    modulation: int  # of the modulation, embeddings included


class StoredModel(Protocol):
    """A model that was read from a file."""

    @property
    def scene(self) -> SceneInfo: ...

    @property
    def step(self) -> int:
        """Steps that it was trained."""
        ...

    @property
    def description(self) -> str:
        """What it is, for a sentence."""
        ...

    @property
    def size(self) -> int:
        """Number of Gaussians, or of the corresponding elements."""
        ...

    @property
    def parameter_counts(self) -> ParameterCounts: ...

    def render(self, camera: Camera, t: float) -> Tensor:
        """Return [H, W, 3] over the scene's background."""
        ...


Reader = Callable[[Path, dict[str, Any], SceneInfo], StoredModel]
"""Reads the path, contents and scene of a file. Errors of damaged contents are any that `load_stored` names."""

OTHERS = {
    frozenset({"splats"}): "gsplat: give the PLY that its trainer writes with --save_ply",
    frozenset({"pipeline"}): "nerfstudio: give the PLY that ns-export gaussian-splat writes",
}
"""Checkpoints of other trainers, by names in them."""

_READERS: dict[str, Reader] = {}


def register_format(name: str, read: Reader) -> None:
    """Register a kind of model files by its format."""
    _READERS[name] = read


def save_stored(path: str | Path, contents: dict[str, Any], model: nn.Module, scene: SceneInfo, step: int) -> None:
    """Write a model file, atomically; `contents` has its `format` and all else that its reader needs."""
    state = {name: tensor.detach().cpu() for name, tensor in model.state_dict().items()}
    common = {"package_version": __version__, "scene": asdict(scene), "step": step, "state": state}
    save_atomic(path, contents | common)


def load_stored(path: str | Path) -> StoredModel:
    """Read a model file of any registered kind onto the CPU. Raises `CheckpointInvalid` for any file that isn't a
    whole, finite model."""
    contents = load(path)
    load_plugins()
    found = contents.get("format") if isinstance(contents, dict) else type(contents).__name__
    if not isinstance(contents, dict) or not isinstance(found, str) or found not in _READERS:
        raise CheckpointInvalid(path, _of_others(contents, found))
    missing = [name for name in ("config", "scene", "step", "state") if name not in contents]
    if missing:
        raise CheckpointInvalid(path, f"isn't a complete model: `{missing[0]}` is missing")
    try:
        refuse_unlike_stored(path, contents["state"])
        _refuse_not_finite(path, contents["state"])
        scene = SceneInfo(**contents["scene"])
        refuse_unusable_scene(path, scene)
        return _READERS[found](Path(path), contents, scene)
    except (ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RuntimeError) as error:
        problem = f": {error}" if isinstance(error, MsdgsError) else ", or one of another version"
        raise CheckpointInvalid(path, f"isn't a complete model{problem}") from error


def _of_others(contents: Any, found: Any) -> str:
    """Why a file can't be read, and what to give instead if its trainer is known by it."""
    if isinstance(found, str) and found.startswith("msdgs-"):
        known = " or ".join(sorted(_READERS))
        return f"isn't a model of format {known} (found {found!r}): train or import it again with this version"
    for keys, trainer in OTHERS.items():
        if isinstance(contents, dict) and keys <= contents.keys():
            return f"is a checkpoint of {trainer}"
    return f"isn't a model of msdgs-train (found {found!r}); of other trainers give the PLY, or the folder of a run"


def _refuse_not_finite(path: str | Path, state: dict[str, Tensor]) -> None:
    # compared as float32: a finite float64 may be infinite in it
    counts = {name: int((~torch.isfinite(tensor.to(torch.float32))).sum()) for name, tensor in state.items()}
    bad = [f"{name} ({count:,} of {state[name].numel():,})" for name, count in counts.items() if count]
    if bad:
        raise CheckpointInvalid(path, f"holds values that are NaN or infinite: {', '.join(bad)}")

"""The networks and settings of another trainer's run, read without running any code in its files."""

import ast
import copy
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from msdgs_export.importers.errors import ImportFailed
from msdgs_export.importers.guard import read_guarded
from msdgs_train.gaussians.safe_load import CheckpointInvalid, load, refuse_unlike_stored

PICKLE_BYTES = 1 << 24
"""Of the part of a torch file with its names, which is searched."""


class State:
    """The finite tensors of a torch file by name, as float32; names of several states begin with `0.`, `1.` and so
    on."""

    def __init__(self, file: Path) -> None:
        self.file = file
        self._values = {name: torch.from_numpy(array) for name, array in read_guarded(read_network, file).items()}

    def __contains__(self, name: str) -> bool:
        return name in self._values

    def names(self) -> list[str]:
        return list(self._values)

    def read(self, name: str, *shape: int | None) -> Tensor:
        """A tensor. Raises `ImportFailed` if it is missing or has another shape; None is any size."""
        if name not in self._values:
            raise ImportFailed(self.file, f"lacks `{name}`")
        tensor = self._values[name]
        fits = len(shape) == tensor.ndim and all(s is None or s == n for s, n in zip(shape, tensor.shape, strict=True))
        if not fits:
            expected = " × ".join("any" if s is None else str(s) for s in shape)
            raise ImportFailed(self.file, f"`{name}` has shape {tuple(tensor.shape)}, not {expected}")
        return tensor

    def part(self, prefix: str) -> "State":
        """The tensors whose names begin with `prefix`, by the rest of their names."""
        found = copy.copy(self)
        found._values = {n.removeprefix(prefix): v for n, v in self._values.items() if n.startswith(prefix)}
        return found

    def with_zeros(self, shapes: Mapping[str, tuple[int, ...]]) -> "State":
        """These tensors and others that are 0, by name and shape."""
        found = copy.copy(self)
        found._values = self._values | {name: torch.zeros(shape) for name, shape in shapes.items()}
        return found

    def fill(self, linear: nn.Module, name: str) -> None:
        """Set weight and bias of a Linear to those stored under `name`."""
        for kind in ("weight", "bias"):
            parameter = linear.get_parameter(kind)
            parameter.copy_(self.read(f"{name}.{kind}", *parameter.shape))


def read_network(file: Path) -> dict[str, np.ndarray]:
    """Read the tensors, in a subprocess. Takes no more memory than a small multiple of the file's size.

    Raises `ImportFailed`.
    """
    try:
        values = load(file)
        if isinstance(values, tuple | list) and all(isinstance(part, Mapping) for part in values):
            values = {f"{i}.{name}": value for i, part in enumerate(values) for name, value in part.items()}
        if not isinstance(values, Mapping) or not all(isinstance(v, Tensor) for v in values.values()):
            raise ImportFailed(file, "isn't the state of a network: tensors by name")
        refuse_unlike_stored(file, values)
    except CheckpointInvalid as error:
        raise ImportFailed(file, str(error).removeprefix(f"{file}: ")) from error
    for name, tensor in values.items():
        if not torch.isfinite(tensor).all():
            raise ImportFailed(file, f"`{name}` holds NaN or infinity")
    return {str(name): tensor.detach().to(torch.float32).numpy() for name, tensor in values.items()}


def stores(file: Path, name: str) -> bool:
    """Whether a torch file has this text among the names of what it stores; nothing is unpickled."""
    try:
        with zipfile.ZipFile(file) as archive:
            parts = [part for part in archive.namelist() if part.endswith("/data.pkl")]
            return any(name.encode() in archive.open(part).read(PICKLE_BYTES) for part in parts)
    except (OSError, zipfile.BadZipFile, NotImplementedError, RuntimeError, ValueError):
        return False  # for the reader to name


class RunFolder:
    """One iteration of a run: its networks and the plain values of its cfg_args."""

    def __init__(self, folder: Path, iteration: int, networks: str) -> None:
        """`networks` is their path in the folder, with `*` for the iteration."""
        name = networks.replace("*", str(iteration))
        if not (folder / name).is_file():
            raise ImportFailed(folder, f"has point_cloud/iteration_{iteration} but no {name}")
        self.state = State(folder / name)
        self.cloud = folder / f"point_cloud/iteration_{iteration}/point_cloud.ply"
        self.settings = _settings(folder / "cfg_args")


def _settings(file: Path) -> dict[str, Any]:
    """The plain values of cfg_args, the text of a Namespace; it isn't executed."""
    try:
        call = ast.parse(file.read_text(), mode="eval").body
    except FileNotFoundError:
        return {}
    except (OSError, SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise ImportFailed(file, f"can't be read: {error}") from error
    keywords = call.keywords if isinstance(call, ast.Call) else ()
    return dict(_literals(keywords))


def _literals(keywords: Iterable[ast.keyword]) -> Iterator[tuple[str, Any]]:
    """Names and values of those that are constants, or lists and dictionaries of constants."""
    for keyword in keywords:
        try:
            yield str(keyword.arg), ast.literal_eval(keyword.value)
        except (ValueError, TypeError, SyntaxError, RecursionError, MemoryError):
            continue

"""Networks of other trainers: tensors by name out of a torch file, no code of which is run."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from export.importers.errors import ImportFailed
from export.importers.guard import read_guarded
from msdgs_train.gaussians.model_file import CheckpointInvalid, load, refuse_unlike_stored


class State:
    """The finite tensors of a file, float32."""

    def __init__(self, file: Path) -> None:
        self.file = file
        self._values = {name: torch.from_numpy(array) for name, array in read_guarded(read_network, file).items()}

    def __contains__(self, name: str) -> bool:
        return name in self._values

    def names(self) -> list[str]:
        return list(self._values)

    def read(self, name: str, *shape: int | None) -> Tensor:
        """The tensor, of the shape given, of which None is any size. Raises `ImportFailed`."""
        if name not in self._values:
            raise ImportFailed(self.file, f"lacks `{name}`")
        tensor = self._values[name]
        fits = len(shape) == tensor.ndim and all(s is None or s == n for s, n in zip(shape, tensor.shape, strict=True))
        if not fits:
            expected = " × ".join("any" if s is None else str(s) for s in shape)
            raise ImportFailed(self.file, f"`{name}` has shape {tuple(tensor.shape)}, not {expected}")
        return tensor


def read_network(file: Path) -> dict[str, np.ndarray]:
    """The tensors, in a process of its own. Raises `ImportFailed`.

    What is read takes no more memory than a small multiple of the file's size.
    """
    try:
        values = load(file)
        if not isinstance(values, Mapping) or not all(isinstance(v, Tensor) for v in values.values()):
            raise ImportFailed(file, "isn't the state of a network: tensors by name")
        refuse_unlike_stored(file, values)
    except CheckpointInvalid as error:
        raise ImportFailed(file, str(error).removeprefix(f"{file}: ")) from error
    for name, tensor in values.items():
        if not torch.isfinite(tensor).all():
            raise ImportFailed(file, f"`{name}` holds NaN or infinity")
    return {str(name): tensor.detach().to(torch.float32).numpy() for name, tensor in values.items()}

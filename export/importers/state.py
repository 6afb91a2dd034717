"""Networks of other trainers: tensors by name out of a torch file, no code of which is run.

What is read takes no more memory than a small multiple of the file's size.
"""

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor, nn

from export.importers.errors import ImportFailed
from msdgs_train.checkpoint import CheckpointInvalid, load

PLAIN = {torch.float16, torch.bfloat16, torch.float32, torch.float64, torch.bool}
PLAIN |= {torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64}
"""Types of numbers."""


class State:
    """The finite tensors of a file."""

    def __init__(self, file: Path) -> None:
        self.file = file
        try:
            values = load(file)
        except CheckpointInvalid as error:
            raise ImportFailed(file, str(error).removeprefix(f"{file}: ")) from error
        if not isinstance(values, Mapping) or not all(isinstance(v, Tensor) for v in values.values()):
            raise ImportFailed(file, "isn't the state of a network: tensors by name")
        _refuse_unlike_stored(file, values)
        for name, tensor in values.items():
            if not torch.isfinite(tensor).all():
                raise ImportFailed(file, f"`{name}` holds NaN or infinity")
        self._values = {str(name): tensor for name, tensor in values.items()}

    def __contains__(self, name: str) -> bool:
        return name in self._values

    def names(self) -> list[str]:
        return list(self._values)

    def read(self, name: str, *shape: int | None) -> Tensor:
        """The tensor, float32; of the shape given, of which None is any size. Raises `ImportFailed`."""
        if name not in self._values:
            raise ImportFailed(self.file, f"lacks `{name}`")
        tensor = self._values[name]
        fits = len(shape) == tensor.ndim and all(s is None or s == n for s, n in zip(shape, tensor.shape, strict=True))
        if not fits:
            expected = " × ".join("any" if s is None else str(s) for s in shape)
            raise ImportFailed(self.file, f"`{name}` has shape {tuple(tensor.shape)}, not {expected}")
        return tensor.to(torch.float32)


def _refuse_unlike_stored(file: Path, values: Mapping[str, Tensor]) -> None:
    """Tensors that aren't rows of plain numbers, or that claim together more of a storage than there is of it.

    Strides of 0 make a few stored bytes a tensor of any size.
    """
    claimed: dict[int, int] = {}
    for name, tensor in values.items():
        if not _is_plain(tensor):
            raise ImportFailed(file, f"`{name}` isn't a dense tensor of plain numbers")
        storage = tensor.untyped_storage()
        claimed.setdefault(storage.data_ptr(), 0)
        claimed[storage.data_ptr()] += tensor.numel() * tensor.element_size()
        if claimed[storage.data_ptr()] > storage.nbytes():
            problem = f"of shape {tuple(tensor.shape)} isn't stored in full: it shares {storage.nbytes():,} bytes"
            raise ImportFailed(file, f"`{name}` {problem}")


def _is_plain(tensor: Tensor) -> bool:
    plain = type(tensor) in (Tensor, nn.Parameter) and tensor.layout is torch.strided and not tensor.is_nested
    return plain and tensor.device.type == "cpu" and tensor.dtype in PLAIN

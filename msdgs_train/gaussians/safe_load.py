"""Torch files: written atomically, and read without trusting them, as tensors and plain values only."""

import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from msdgs_serve.scene.errors import MsdgsError
from msdgs_serve.scene.foreign import LFS_POINTER, START_BYTES, is_lfs_pointer
from msdgs_serve.writing import reason, replacing

PLAIN = {torch.float16, torch.bfloat16, torch.float32, torch.float64, torch.bool}
PLAIN |= {torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64}
"""Supported dtypes."""


class CheckpointInvalid(MsdgsError):
    """A checkpoint can't be read, or holds values that no model can use."""

    def __init__(self, file: str | Path, problem: str) -> None:
        super().__init__(f"{file}: {problem}")


def save_atomic(path: str | Path, obj: Any) -> None:
    """Write `obj` with `torch.save`, atomically. Raises `WriteFailed`."""
    with replacing(Path(path)) as temporary:
        try:
            with temporary.open("wb") as file:
                torch.save(obj, file)
        except RuntimeError as error:  # of the archive's end, which hides the error that broke it off
            cause: BaseException | None = error
            while cause is not None and not isinstance(cause, OSError | KeyboardInterrupt):
                cause = cause.__context__
            raise cause or error from None


def load(path: str | Path) -> Any:
    """Load tensors and plain values onto the CPU; no code in the file is run. Raises `CheckpointInvalid`."""
    path = Path(path)
    try:
        size = path.stat().st_size
        if size == 0:
            raise CheckpointInvalid(path, "is empty")
        with path.open("rb") as file:
            if is_lfs_pointer(file.read(START_BYTES)):
                raise CheckpointInvalid(path, LFS_POINTER)
        if not zipfile.is_zipfile(path):
            raise CheckpointInvalid(path, f"isn't a torch checkpoint, or is cut off after {size:,} bytes")
        with zipfile.ZipFile(path) as archive:
            unpacked = sum(entry.file_size for entry in archive.infolist())
        if unpacked > size:  # a zip bomb
            raise CheckpointInvalid(path, f"is packed: it holds {unpacked:,} bytes; torch.save packs nothing")
        return torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError as error:
        raise CheckpointInvalid(path, "no such file") from error
    except OSError as error:
        raise CheckpointInvalid(path, f"can't be read: {reason(error)}") from error
    except CheckpointInvalid:
        raise
    except Exception as error:  # a damaged pickle raises errors of any type
        raise CheckpointInvalid(path, "isn't a whole torch checkpoint of tensors and plain values alone") from error


def refuse_unlike_stored(path: str | Path, tensors: Mapping[str, Tensor]) -> None:
    """Raise `CheckpointInvalid` for tensors that aren't dense plain numbers, or are larger than their storage.

    With strides of 0, a few stored bytes can claim to be a tensor of any size.
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

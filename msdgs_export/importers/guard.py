"""Readers that use native code, such as WebP, zstd or torch, run in a subprocess."""

import importlib
import json
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import BinaryIO

import numpy as np

from msdgs_export.importers.errors import ImportFailed
from msdgs_serve.guarded import ProcessFailed, ProcessLimits, call_guarded

Arrays = Mapping[str, np.ndarray]

MEMORY, MEMORY_PER_BYTE = 2 << 30, 1 << 10
"""Memory limit of the subprocess in bytes: its own, with torch, and per byte of the file, which may be compressed."""

SECONDS, SECONDS_PER_BYTE = 120.0, 1e-5


def read_guarded(read: Callable[..., Arrays], path: Path, *options: str) -> dict[str, np.ndarray]:
    """The arrays that a module's function `read` returns for a file or folder. Raises `ImportFailed`."""
    files = [each for each in path.iterdir() if each.is_file()] if path.is_dir() else [path]
    size = sum(file.stat().st_size for file in files)
    memory = MEMORY + MEMORY_PER_BYTE * size
    limits = ProcessLimits(memory, written=memory, seconds=SECONDS + SECONDS_PER_BYTE * size)
    with tempfile.TemporaryFile() as answer:
        try:
            where = read.__module__, read.__name__
            call_guarded(write_arrays, *where, str(path), *options, limits=limits, answer=answer)
        except ProcessFailed as error:
            raise ImportFailed(path, f"is damaged: it {error}") from None
        with np.load(answer, allow_pickle=False) as parts:
            header, *arrays = parts.values()
    found = json.loads(header.tobytes())
    if found["problem"] is not None:
        raise ImportFailed(path, found["problem"])
    return dict(zip(found["names"], arrays, strict=True))


def write_arrays(answer: BinaryIO, module: str, name: str, path: str, *options: str) -> None:
    """In the subprocess: write an .npz of the arrays and a header, which has their names or the problem of the file."""
    arrays: Arrays = {}
    problem = None
    try:
        arrays = getattr(importlib.import_module(module), name)(Path(path), *options)
    except ImportFailed as error:
        problem = error.problem
    except OSError as error:
        problem = f"can't be read: {error.strerror or error}"
    header = json.dumps({"names": list(arrays), "problem": problem}).encode()
    np.savez(answer, np.frombuffer(header, np.uint8), *arrays.values())

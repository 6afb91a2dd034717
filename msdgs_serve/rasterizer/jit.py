"""How every kernel is compiled: GIL released, cached on disk, one set of floating-point freedoms."""

import hashlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numba
from numba.core import config

from msdgs_serve.rasterizer.kernel_files import CheckedFiles, use_writable_folder

FAST_MATH = {"nsz", "arcp", "contract"}
"""Fused multiply-add and reciprocals. Not `reassoc`, which breaks the exponential's rounding; not `nnan` and `ninf`,
which would make the tests with NaN and infinity mean nothing."""

RASTERIZER = Path(__file__).parent
SCENE = RASTERIZER.parent / "scene"
STORED = use_writable_folder(RASTERIZER.parent)


def kernel(function: Callable, *, inlined: bool = False) -> Any:
    """Decorate a function that numba compiles; it may use kernels and constants of the rasterizer, of
    `msdgs_serve.scene` and of the function's own folder. `inlined`: into its callers, whatever its size."""
    compiled: Any = numba.njit(nogil=True, cache=STORED, fastmath=FAST_MATH, error_model="numpy", forceinline=inlined)(
        function
    )
    if STORED and not config.DISABLE_JIT:  # pyright: ignore[reportAttributeAccessIssue]
        # numba's index carries a stamp of the function's own file and is void when that changes. Kernels and constants
        # of other files are compiled in too, and numba has no public way to say so: their digest joins the stamp.
        index = compiled._cache._cache_file
        index.__class__ = CheckedFiles
        index._source_stamp = (index._source_stamp, digest_of_sources(Path(function.__code__.co_filename).parent))
    return compiled


def inlined_kernel(function: Callable) -> Any:
    """`kernel`, where a call would cost too much."""
    return kernel(function, inlined=True)


@cache
def digest_of_sources(folder: Path) -> str:
    """Of the Python files in the rasterizer's folder, in the scene's and in this one; about 1 ms."""
    digest = hashlib.sha256()
    for path in sorted(file for part in {RASTERIZER, SCENE, folder} for file in part.glob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()

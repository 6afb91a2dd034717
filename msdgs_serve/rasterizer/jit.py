"""How all kernels are compiled: GIL released, cached on disk, with one set of fast-math flags."""

import hashlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numba
from numba.core import config

from msdgs_serve.rasterizer.kernel_files import CheckedFiles, use_writable_folder

FAST_MATH = {"nsz", "arcp", "contract"}
"""Fused multiply-add and reciprocals. Not `reassoc`, which breaks the rounding in `exp2`; not `nnan` and `ninf`, which
would void checks for NaN and infinity."""

RASTERIZER = Path(__file__).parent
FOLLOWED = (RASTERIZER, RASTERIZER / "simd", RASTERIZER.parent / "scene")
STORED = use_writable_folder(RASTERIZER.parent)


def kernel(function: Callable, *, inlined: bool = False) -> Any:
    """Decorate a function that numba compiles. It may use kernels and constants of the folders
    `FOLLOWED` and of the function's own. `inlined` forces inlining into its callers."""
    compiled: Any = numba.njit(nogil=True, cache=STORED, fastmath=FAST_MATH, error_model="numpy", forceinline=inlined)(
        function
    )
    if STORED and not config.DISABLE_JIT:  # pyright: ignore[reportAttributeAccessIssue]
        # numba invalidates the cache when the function's own file changes. Kernels and constants of other files are
        # compiled in too, but numba has no public way to declare that: their digest is added to the file's stamp.
        index = compiled._cache._cache_file
        index.__class__ = CheckedFiles
        index._source_stamp = (index._source_stamp, digest_of_sources(Path(function.__code__.co_filename).parent))
    return compiled


def inlined_kernel(function: Callable) -> Any:
    """Decorate as `kernel` does, and force inlining into the callers."""
    return kernel(function, inlined=True)


@cache
def digest_of_sources(folder: Path) -> str:
    """Return the digest of the Python files in the folders `FOLLOWED` and in `folder`; about 1 ms."""
    digest = hashlib.sha256()
    for path in sorted(file for part in {*FOLLOWED, folder} for file in part.glob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()

"""All kernels that drawing needs, compiled before the first request: when a container image is built, say."""

import os
from pathlib import Path

import numpy as np
from numba.core import config

from msdgs_serve.rasterizer.jit import RASTERIZER
from msdgs_serve.rasterizer.kernel_files import is_writable
from msdgs_serve.rasterizer.rasterize import rasterize
from msdgs_serve.rasterizer.tiles import SPLATS_PER_PART
from msdgs_serve.scene.camera import Camera, look_at
from msdgs_serve.scene.errors import MsdgsError
from msdgs_serve.scene.gaussians import Gaussians

SIZE = 32
"""Pixels along a side: several tiles."""
COUNTS = (40, SPLATS_PER_PART + 40)
"""Gaussians: more than one group of lanes, and a rest; few, and so many that they are sorted in parts."""


class KernelsNotStored(MsdgsError):
    """Compiling would be lost: nothing can be written where kernels are looked for."""


def compile_kernels() -> Path:
    """Draw tiny float32 frames, so that every kernel of `rasterize` is on disk: one serves all cameras and scenes.

    They are good for processors of the kind of this one. Returns the folder that has them. Raises `KernelsNotStored`.
    """
    folder = Path(os.environ.get("NUMBA_CACHE_DIR") or RASTERIZER.parent)
    if config.DISABLE_JIT:  # pyright: ignore[reportAttributeAccessIssue]
        raise KernelsNotStored("nothing is compiled while NUMBA_DISABLE_JIT is set")
    if not is_writable(folder):
        raise KernelsNotStored(f"kernels are kept in {folder}, which can't be written; NUMBA_CACHE_DIR names another")
    pose = look_at(np.array([0.0, 0.0, -4.0]), np.zeros(3), np.array([0.0, -1.0, 0.0]))
    for count in COUNTS:
        for depth in (False, True):
            rasterize(_gaussians(count), Camera(SIZE, SIZE, SIZE / 2, SIZE / 2, SIZE, SIZE, pose), depth=depth)
    return folder


def _gaussians(count: int) -> Gaussians:
    random = np.random.default_rng(0)
    return Gaussians(
        means=random.uniform(-1, 1, (count, 3)).astype(np.float32),
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        scales=np.full((count, 3), 0.1, np.float32),
        opacities=np.full(count, 0.5, np.float32),
        sh=np.zeros((count, 1, 3), np.float32),
    )

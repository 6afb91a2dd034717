"""Compile all kernels of the rasterizer before the first request, for example while a container image is built."""

import os
from pathlib import Path

import numpy as np
from numba.core import config

from msdgs_serve.rasterizer.frame_sequence import FrameSequence
from msdgs_serve.rasterizer.jit import RASTERIZER
from msdgs_serve.rasterizer.kernel_files import is_writable
from msdgs_serve.rasterizer.rasterize import rasterize
from msdgs_serve.rasterizer.tiles import SPLATS_PER_PART
from msdgs_serve.scene.camera import Camera, look_at
from msdgs_serve.scene.errors import MsdgsError
from msdgs_serve.scene.gaussians import Gaussians
from msdgs_serve.scene.static_bounds import static_bounds

SIZE = 32
"""Pixels along a side of the image: several tiles."""
COUNTS = (40, SPLATS_PER_PART + 40)
"""Numbers of Gaussians: several vectors and a remainder, sorted serially and sorted in parallel parts."""


class KernelsNotStored(MsdgsError):
    """The folder in which compiled kernels are looked for can't be written."""


def compile_kernels() -> Path:
    """Store every kernel of `rasterize` on disk, which serve all cameras and scenes on processors of this kind.

    Return the folder in which they are. Raises `KernelsNotStored`.
    """
    folder = Path(os.environ.get("NUMBA_CACHE_DIR") or RASTERIZER.parent)
    if config.DISABLE_JIT:  # pyright: ignore[reportAttributeAccessIssue]
        raise KernelsNotStored("kernels are not compiled while NUMBA_DISABLE_JIT is set")
    if not is_writable(folder):
        raise KernelsNotStored(
            f"compiled kernels are stored in {folder}, which can't be written; set NUMBA_CACHE_DIR to another folder"
        )
    load_kernels()
    return folder


def load_kernels() -> None:
    """Draw tiny float32 frames, so that numba's modules and every kernel of `rasterize` are loaded, or compiled if they
    aren't stored: in 24 s of CPU time, of which 18 are for a frame of colors alone."""
    for count in COUNTS:
        gaussians = _gaussians(count)
        static = static_bounds(0, gaussians.means, gaussians.scales)
        for more in (False, True):
            rasterize(gaussians, _camera(), depth=more, counts=more, static=static)
            FrameSequence(gaussians, count, _camera(), depth=more).frame(gaussians)


def _camera() -> Camera:
    pose = look_at(np.array([0.0, 0.0, -4.0]), np.zeros(3), np.array([0.0, -1.0, 0.0]))
    return Camera(SIZE, SIZE, SIZE / 2, SIZE / 2, SIZE, SIZE, pose)


def _gaussians(count: int) -> Gaussians:
    random = np.random.default_rng(0)
    return Gaussians(
        means=random.uniform(-1, 1, (count, 3)).astype(np.float32),
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        scales=np.full((count, 3), 0.1, np.float32),
        opacities=np.full(count, 0.5, np.float32),
        sh=np.zeros((count, 1, 3), np.float32),
    )

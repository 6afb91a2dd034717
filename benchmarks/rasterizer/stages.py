"""The stages, work and memory of a frame, and its gradient."""

import tracemalloc
from typing import Any, NamedTuple

import numpy as np

from benchmarks.measuring import Times
from benchmarks.rasterizer.roofline import FLOPS_PER_PAIR, Machine
from benchmarks.rasterizer.scenes import Case
from msdgs_serve.rasterizer import GSPLAT, rasterize
from msdgs_serve.rasterizer.compositing import composite
from msdgs_serve.rasterizer.counts import count_splats
from msdgs_serve.rasterizer.projection import project
from msdgs_serve.rasterizer.scratch import release_scratch
from msdgs_serve.rasterizer.tiles import bin_into_tiles

STAGES = ("project", "bin", "composite", "total")


class Work(NamedTuple):
    """Exact counts of the work of one frame."""

    visible: int  # splats
    tile_entries: int  # splats in tiles
    evaluated: int  # pairs of a splat and a pixel of the unfinished 4 × 4 blocks that it touches: the arithmetic
    blended: int  # pairs of a splat and a pixel to which it contributes


def draw_in_stages(case: Case, times: Times) -> None:
    """Draw a frame as a whole, then in stages."""
    gaussians, camera = case.gaussians, case.camera
    size, background = (camera.width, camera.height), np.zeros(3, gaussians.means.dtype)
    times.time("total", rasterize, gaussians, camera)
    splats = times.time("project", project, gaussians, camera, GSPLAT)
    tiles = times.time("bin", bin_into_tiles, splats, *size)
    times.time("composite", composite, splats, tiles, *size, background, GSPLAT)


class Gradient:
    """A frame and its gradient by autograd, as in training."""

    def __init__(self, case: Case) -> None:
        import torch

        from msdgs_train.rendering.rasterize import rasterize as rasterize_for_training

        g = case.gaussians
        arrays = (g.means, g.quats, g.scales, g.opacities, g.sh)
        self._tensors = [torch.from_numpy(array).requires_grad_() for array in arrays]
        means, quats, scales, opacities, sh = self._tensors
        scene = (means, quats, scales, opacities, sh, case.camera, torch.zeros(3))
        self._draw = lambda: rasterize_for_training(*scene)[:2]
        rng = torch.Generator().manual_seed(0)
        self._gradients = [torch.randn(channel.shape, generator=rng) for channel in self._draw()]
        self._autograd = torch.autograd.grad

    def draw(self, times: Times) -> None:
        """Draw a frame and compute its gradient."""
        channels = times.time("forward", self._draw)
        times.time("backward", self._autograd, channels, self._tensors, self._gradients)


def work_of(case: Case) -> Work:
    """Count the pairs that the compositing would blend."""
    camera = case.camera
    splats = project(case.gaussians, camera, GSPLAT)
    tiles = bin_into_tiles(splats, camera.width, camera.height)
    counts = count_splats(splats, tiles, camera.width, camera.height, GSPLAT)
    return Work(splats.visible, len(tiles.splat_ids), counts.evaluated, int(counts.blended.sum(dtype=float)))


def memory_of(case: Case) -> int:
    """Peak bytes of NumPy arrays while a frame is drawn, without the Gaussians and the frame itself. Scratch memory of
    the threads, some 20 kB each, belongs to numba and isn't counted."""
    rasterize(case.gaussians, case.camera)
    release_scratch()
    tracemalloc.start()
    try:
        frame = rasterize(case.gaussians, case.camera)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    return peak - sum(channel.nbytes for channel in frame)


def row_of(case: Case, times: Times, work: Work, memory: int, machine: Machine) -> dict[str, Any]:
    """All figures of one case."""
    milliseconds = times.milliseconds()
    gaussians, camera = case.gaussians, case.camera
    total, floor = milliseconds["total"]["min"], floor_of(case, work, machine)
    return {
        "scene": case.name,
        "title": case.title(),
        "count": len(gaussians),
        "size": [camera.width, camera.height],
        "milliseconds": milliseconds,
        "repeats": len(times.seconds["total"]),
        **work._asdict(),
        "ns_per_pair": 1e6 * total / max(work.blended, 1),
        "pairs_per_second": 1e3 * work.blended / total,
        "floor_milliseconds": floor,
        "memory_bytes": memory,
        "bytes_per_splat": (memory - 4 * work.tile_entries) / len(gaussians),
    }


def floor_of(case: Case, work: Work, machine: Machine) -> dict[str, float]:
    """Lower bounds in milliseconds at the highest rates of this run.

    `arithmetic`: of blended pairs; `evaluated`: of all pixels of the 4 × 4 blocks that splats touch; `memory`: of
    reading Gaussians, writing and reading records once and tile lists twice, and writing the frame.
    """
    g = case.gaussians
    bytes_in = sum(array.nbytes for array in (g.means, g.quats, g.scales, g.opacities, g.sh))
    pixels = case.camera.width * case.camera.height
    moved = bytes_in + 2 * 64 * len(g) + 8 * work.tile_entries + 20 * pixels
    return {
        "arithmetic": work.blended * FLOPS_PER_PAIR / machine.gflops / 1e6,
        "evaluated": work.evaluated * FLOPS_PER_PAIR / machine.gflops / 1e6,
        "memory": moved / machine.gigabytes / 1e6,
    }

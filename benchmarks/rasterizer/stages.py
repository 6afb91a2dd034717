"""Where a frame's time goes: stages, work, memory, and the gradient."""

import tracemalloc
from typing import Any, NamedTuple

import numpy as np

from benchmarks.measuring import Times
from benchmarks.rasterizer.roofline import FLOPS_PER_PAIR, Machine
from benchmarks.rasterizer.scenes import Case
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.rasterizer import GSPLAT, as_trained, rasterize
from msdgs_serve.rasterizer.compositing import composite
from msdgs_serve.rasterizer.counts import count_splats
from msdgs_serve.rasterizer.projection import project
from msdgs_serve.rasterizer.tiles import bin_into_tiles

STAGES = ("project", "bin", "composite", "total")


class Work(NamedTuple):
    """How much there is to do in one frame, counted exactly and apart from what is timed."""

    visible: int  # splats
    tile_entries: int  # splats in tiles
    evaluated: int  # splats in pixels of the 4 × 4 blocks that they touch and that are not done: the arithmetic
    blended: int  # splats in pixels to which they add


def draw_in_stages(case: Case, times: Times) -> None:
    """Once as a whole, once in stages."""
    gaussians, camera = case.gaussians, case.camera
    size, background = (camera.width, camera.height), np.zeros(3, gaussians.means.dtype)
    times.time("total", rasterize, gaussians, camera)
    splats = times.time("project", project, gaussians, camera, GSPLAT)
    tiles = times.time("bin", bin_into_tiles, splats, *size)
    times.time("composite", composite, splats, tiles, *size, background, GSPLAT)


class Gradient:
    """A frame and its gradient as training has them, through autograd."""

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
        """Once forward, once backward."""
        channels = times.time("forward", self._draw)
        times.time("backward", self._autograd, channels, self._tensors, self._gradients)


def work_of(case: Case) -> Work:
    """The decisions of the compositing, counted instead of blended."""
    camera = case.camera
    splats = project(case.gaussians, camera, GSPLAT)
    tiles = bin_into_tiles(splats, camera.width, camera.height)
    counts = count_splats(splats, tiles, camera.width, camera.height, GSPLAT)
    return Work(splats.visible, len(tiles.splat_ids), counts.evaluated, int(counts.blended.sum(dtype=float)))


def memory_of(case: Case) -> int:
    """Bytes of NumPy's arrays at a frame's peak, beside the Gaussians and the frame itself; threads' scratch, some
    20 kB each, is numba's and not seen."""
    rasterize(case.gaussians, case.camera)
    tracemalloc.start()
    try:
        frame = rasterize(case.gaussians, case.camera)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    return peak - sum(channel.nbytes for channel in frame)


def row_of(case: Case, times: Times, work: Work, memory: int, machine: Machine) -> dict[str, Any]:
    """All figures of one scene and size."""
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
    """Milliseconds that the machine needs at least, at the rates that this run has seen.

    `arithmetic`: of the pairs that are blended; `evaluated`: of all pixels of the 4 × 4 blocks that splats touch;
    `memory`: reading Gaussians, writing and reading records once, tile lists twice, writing the frame.
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


def draw_scene(session: DeformationSession, width: int, part: float, times: Times) -> None:
    """A frame of a scene file at a part of its time, from its first camera: `pose` and `draw`."""
    metadata = session.scene.metadata
    t0, t1 = metadata.time_range
    stored = metadata.cameras[0].camera
    camera = stored.resized(width, max(1, round(stored.height * width / stored.width)))
    gaussians = times.time("pose", session.gaussians, t0 + (t1 - t0) * part)
    times.time(
        "draw", lambda: rasterize(gaussians, camera, background=metadata.background, options=as_trained(metadata))
    )

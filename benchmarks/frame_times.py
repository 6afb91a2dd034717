"""Where a frame's time goes: stages, work, memory, and the gradient, of seeded scenes or real ones, in turns."""

import time
import tracemalloc
from collections import defaultdict
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from benchmarks.pair_counts import PairCounts, count_pairs
from benchmarks.roofline import FLOPS_A_PAIR, Machine
from msdgs_serve.rasterizer import GSPLAT, rasterize
from msdgs_serve.rasterizer.compositing import composite
from msdgs_serve.rasterizer.projection import project
from msdgs_serve.rasterizer.tiles import bin_into_tiles
from msdgs_serve.scene import Camera, Gaussians

STAGES = ("project", "bin", "composite")


class Subject(NamedTuple):
    """What is drawn."""

    name: str
    gaussians: Gaussians
    camera: Camera


class Times:
    """Seconds of things that take turns, by name."""

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self._clock = clock
        self.seconds: dict[str, list[float]] = defaultdict(list)

    def add(self, name: str, seconds: float) -> None:
        self.seconds[name].append(seconds)

    def time(self, name: str, function: Callable, *arguments: Any) -> Any:
        """What the function returns."""
        start = self._clock()
        result = function(*arguments)
        self.add(name, self._clock() - start)
        return result

    def milliseconds(self) -> dict[str, dict[str, float]]:
        """Minimum and median of each."""
        return {
            name: {"min": 1e3 * min(seconds), "median": 1e3 * float(np.median(seconds))}
            for name, seconds in self.seconds.items()
        }


def draw_in_stages(subject: Subject, times: Times) -> None:
    """Once as a whole, once in stages."""
    gaussians, camera = subject.gaussians, subject.camera
    size, background = (camera.width, camera.height), np.zeros(3, gaussians.means.dtype)
    times.time("total", rasterize, gaussians, camera)
    splats = times.time("project", project, gaussians, camera, GSPLAT)
    tiles = times.time("bin", bin_into_tiles, splats, *size)
    times.time("composite", composite, splats, tiles, *size, background, GSPLAT)


class Gradient:
    """A frame and its gradient as training has them, through autograd."""

    def __init__(self, subject: Subject) -> None:
        import torch

        from msdgs_train.rendering.rasterize import rasterize as rasterize_for_training

        g = subject.gaussians
        arrays = (g.means, g.quats, g.scales, g.opacities, g.sh)
        self._tensors = [torch.from_numpy(array).requires_grad_() for array in arrays]
        means, quats, scales, opacities, sh = self._tensors
        scene = (means, quats, scales, opacities, sh, subject.camera, torch.zeros(3))
        self._draw = lambda: rasterize_for_training(*scene)[:2]
        rng = torch.Generator().manual_seed(0)
        self._gradients = [torch.randn(channel.shape, generator=rng) for channel in self._draw()]
        self._autograd = torch.autograd.grad

    def draw(self, times: Times) -> None:
        """Once forward, once backward."""
        channels = times.time("forward", self._draw)
        times.time("backward", self._autograd, channels, self._tensors, self._gradients)


def work_of(subject: Subject) -> PairCounts:
    """Counted apart from what is timed."""
    camera = subject.camera
    splats = project(subject.gaussians, camera, GSPLAT)
    tiles = bin_into_tiles(splats, camera.width, camera.height)
    return count_pairs(splats, tiles, camera.width, camera.height, GSPLAT)


def memory_of(subject: Subject) -> int:
    """Bytes of NumPy's arrays at a frame's peak, beside the Gaussians and the frame itself; threads' scratch, some
    20 kB each, is numba's and not seen."""
    rasterize(subject.gaussians, subject.camera)
    tracemalloc.start()
    try:
        frame = rasterize(subject.gaussians, subject.camera)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    return peak - sum(channel.nbytes for channel in frame)


def row_of(subject: Subject, times: Times, work: PairCounts, memory: int, machine: Machine) -> dict[str, Any]:
    """All figures of one scene and size."""
    milliseconds = times.milliseconds()
    gaussians, camera = subject.gaussians, subject.camera
    total, floor = milliseconds["total"]["min"], floor_of(subject, work, machine)
    return {
        "scene": subject.name,
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


def floor_of(subject: Subject, work: PairCounts, machine: Machine) -> dict[str, float]:
    """Milliseconds that the machine needs at least, at the rates that this run has seen.

    `arithmetic`: of the pairs that are blended; `lanes`: of all pixels of the 4 × 4 blocks that splats touch; `memory`:
    reading Gaussians, writing and reading records once, tile lists twice, writing the frame.
    """
    g = subject.gaussians
    bytes_in = sum(array.nbytes for array in (g.means, g.quats, g.scales, g.opacities, g.sh))
    pixels = subject.camera.width * subject.camera.height
    moved = bytes_in + 2 * 64 * len(g) + 8 * work.tile_entries + 20 * pixels
    return {
        "arithmetic": work.blended * FLOPS_A_PAIR / machine.gflops / 1e6,
        "lanes": work.lanes * FLOPS_A_PAIR / machine.gflops / 1e6,
        "memory": moved / machine.gigabytes / 1e6,
    }

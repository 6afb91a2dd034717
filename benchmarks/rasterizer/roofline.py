"""The limits of this machine, measured by two kernels on the rasterizer's own threads and SIMD vectors."""

import time
from typing import NamedTuple

import numpy as np

from msdgs_serve.rasterizer.jit import kernel
from msdgs_serve.rasterizer.simd.memory import load, store
from msdgs_serve.rasterizer.simd.types import NUM_LANES
from msdgs_serve.rasterizer.simd.vectors import fma, spread
from msdgs_serve.threads import run_parallel, split_evenly, thread_count

FLOPS_PER_PAIR = 37
"""Operations of one splat in one pixel, an fma counted twice: dx, dy 2; root times that 4; squares and log2 of the
opacity 4; 2^x 13 (rounding 3, polynomial of degree 5: 10); two thresholds 2; transmittance 3, end test 1; three colors
and depth 8."""

CHAINS = 8
ROUNDS = 200_000
BANDWIDTH_BYTES = 1 << 28


class Machine(NamedTuple):
    """The highest rates of any repeat."""

    gflops: float  # float32, an fma counted twice
    gigabytes: float  # per second, read and written


class Roofline:
    """Takes a sample in each turn of a benchmark, so that both see the same speed of the machine."""

    def __init__(self) -> None:
        self.machine = Machine(0.0, 0.0)
        count = BANDWIDTH_BYTES // 8
        self._source, self._target = np.ones(count, np.float32), np.zeros(count, np.float32)
        self._scratch = [np.linspace(0, 1, CHAINS * NUM_LANES, dtype=np.float32) for _ in range(thread_count())]

    def sample(self) -> None:
        """Measure both rates for about 0.1 s."""
        flops = 2 * NUM_LANES * CHAINS * ROUNDS * thread_count()
        rate = flops / _seconds(_multiply_add, [(scratch, ROUNDS) for scratch in self._scratch]) / 1e9
        groups = split_evenly(len(self._source) // NUM_LANES, thread_count())
        ranges = [(first * NUM_LANES, past * NUM_LANES, self._source, self._target) for first, past in groups]
        bandwidth = BANDWIDTH_BYTES / _seconds(_copy_range, ranges) / 1e9
        self.machine = Machine(max(self.machine.gflops, rate), max(self.machine.gigabytes, bandwidth))


def _seconds(function: object, items: list[tuple]) -> float:
    start = time.perf_counter()
    run_parallel(function, items)  # pyright: ignore[reportArgumentType]
    return time.perf_counter() - start


@kernel
def _multiply_add(numbers: np.ndarray, rounds: int) -> None:
    """Eight independent chains: enough for two units with a latency of four cycles."""
    factor, term = spread(np.float32(0.999)), spread(np.float32(0.001))
    a, b, c, d = load(numbers, 0), load(numbers, 16), load(numbers, 32), load(numbers, 48)
    e, f, g, h = load(numbers, 64), load(numbers, 80), load(numbers, 96), load(numbers, 112)
    for _ in range(rounds):
        a, b, c, d = fma(a, factor, term), fma(b, factor, term), fma(c, factor, term), fma(d, factor, term)
        e, f, g, h = fma(e, factor, term), fma(f, factor, term), fma(g, factor, term), fma(h, factor, term)
    store(numbers, 0, a + b + c + d + e + f + g + h)


@kernel
def _copy_range(start: int, stop: int, source: np.ndarray, target: np.ndarray) -> None:
    for k in range(np.uint64(start), np.uint64(stop), np.uint64(NUM_LANES)):
        store(target, k, load(source, k))

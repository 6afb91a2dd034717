"""Sixteen threads that draw frames of different sizes at once, for some seconds or for `MSDGS_HAMMER_SECONDS`."""

import ctypes
import multiprocessing
import os
import time
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from msdgs_serve.rasterizer import rasterize
from tests.support.scenes import Scene, as_dtype, random_scene
from tests.support.tolerances import tolerance

pytestmark = pytest.mark.slow

THREADS = 16
SECONDS = float(os.environ.get("MSDGS_HAMMER_SECONDS", "3"))
SIZES = ((1, 1), (16, 16), (53, 37), (300, 200), (17, 400), (640, 480), (128, 129), (1000, 40))
MEMORY = Path("/proc/self/statm")


def scenes() -> list[Scene]:
    """From none to thousands of splats, both dtypes."""
    made = [random_scene(80 + k, count, *SIZES[k]) for k, count in enumerate((10, 0, 500, 3000, 33, 1000, 1, 800))]
    return [(as_dtype(scene, np.float64) if k % 3 == 2 else scene, camera) for k, (scene, camera) in enumerate(made)]


def bytes_of(scene: Scene) -> list[bytes]:
    return [channel.tobytes() for channel in rasterize(*scene)]


def resident_bytes() -> int:
    """What is in use: glibc first gives back what it keeps for the next arrays, which is up to 90 MB here."""
    if trim := getattr(ctypes.CDLL(None), "malloc_trim", None):
        trim(0)
    return int(MEMORY.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def hammer(seconds: float) -> tuple[int, int, int]:
    """Draw in all threads at once. Bytes in use once each thread has drawn each scene, bytes in the end, and frames."""
    drawn = scenes()
    expected = [bytes_of(scene) for scene in drawn]

    def draw(thread: int, deadline: float) -> int:
        """All scenes once, and more until the deadline; how many frames that were."""
        order, frames = np.random.default_rng(thread), 0
        while frames < len(drawn) or time.monotonic() < deadline:
            for k in order.permutation(len(drawn)):
                assert bytes_of(drawn[k]) == expected[k], f"scene {k} in thread {thread}"
            frames += len(drawn)
        return frames

    resident, frames = list[int](), 0
    with ThreadPoolExecutor(THREADS) as threads:
        for duration in (0.0, seconds):
            deadlines = [time.monotonic() + duration] * THREADS
            frames += sum(threads.map(draw, range(THREADS), deadlines))
            resident.append(resident_bytes())
    return resident[0], resident[1], frames


@pytest.mark.skipif(not MEMORY.exists(), reason="no /proc/self/statm to read a process's memory from")
def test_many_threads_at_once():
    """Same bytes as serial frames, and memory that doesn't grow; in a process in which nothing else happens."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
        warm, end, frames = process.submit(hammer, SECONDS).result()
    assert end - warm <= tolerance("hammer.growth"), f"{frames} frames"

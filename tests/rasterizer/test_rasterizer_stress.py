"""Sixteen threads that draw frames of different sizes at once, for a second or with `make fuzz` for longer."""

import multiprocessing
import time
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor

import numpy as np
import pytest

from msdgs_serve.rasterizer import rasterize
from tests.support.fuzzing import CASES
from tests.support.memory import STATUS, resident_megabytes
from tests.support.scenes import Scene, as_dtype, random_scene
from tests.support.tolerances import tolerance

pytestmark = pytest.mark.slow

THREADS = 16
SECONDS = CASES / 20
SIZES = ((1, 1), (16, 16), (53, 37), (300, 200), (17, 400), (640, 480), (128, 129), (1000, 40))


def scenes() -> list[Scene]:
    """Return scenes of none to thousands of splats, in both dtypes."""
    made = [random_scene(80 + k, count, *SIZES[k]) for k, count in enumerate((10, 0, 500, 3000, 33, 1000, 1, 800))]
    return [(as_dtype(scene, np.float64) if k % 3 == 2 else scene, camera) for k, (scene, camera) in enumerate(made)]


def bytes_of(scene: Scene) -> list[bytes]:
    return [channel.tobytes() for channel in rasterize(*scene)]


def stress(seconds: float) -> tuple[float, float, int]:
    """Render in all threads; return MiB in use once each thread has rendered each scene, MiB in the end, and frames."""
    drawn = scenes()
    expected = [bytes_of(scene) for scene in drawn]

    def draw(thread: int, deadline: float) -> int:
        """Render all scenes once, and more until the deadline; return the number of frames."""
        order, frames = np.random.default_rng(thread), 0
        while frames < len(drawn) or time.monotonic() < deadline:
            for k in order.permutation(len(drawn)):
                assert bytes_of(drawn[k]) == expected[k], f"scene {k} in thread {thread}"
            frames += len(drawn)
        return frames

    resident, frames = list[float](), 0
    with ThreadPoolExecutor(THREADS) as threads:
        for duration in (0.0, seconds):
            deadlines = [time.monotonic() + duration] * THREADS
            frames += sum(threads.map(draw, range(THREADS), deadlines))
            resident.append(resident_megabytes())
    return resident[0], resident[1], frames


@pytest.mark.skipif(not STATUS.exists(), reason="reads the process's memory from /proc")
def test_many_threads_at_once():
    """Same bytes as serial frames, and memory that doesn't grow; in a process in which nothing else happens."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
        warm, end, frames = process.submit(stress, SECONDS).result()
    assert end - warm <= tolerance("stress.growth"), f"{frames} frames"

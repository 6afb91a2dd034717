"""Same bytes from any number of threads; compiled once for all processes and array layouts."""

import sys
from dataclasses import replace

import numpy as np
import pytest
from numba.core.dispatcher import Dispatcher

from msdgs_serve.rasterizer import Rendering, tiles
from msdgs_serve.scene import Gaussians
from tests.support.processes import run_python
from tests.support.scenes import FIELDS, as_dtype, draw, random_scene

COUNT_COMPILATIONS = """
from tests.rasterizer.test_rasterizer_threads import kernels
from tests.support.scenes import FIELDS, draw, random_scene
draw(*random_scene(40, 12, 19, 13))
stats = [kernel.stats for kernel in kernels()]
print(sum(sum(s.cache_hits.values()) for s in stats), sum(sum(s.cache_misses.values()) for s in stats))
"""


def kernels() -> list[Dispatcher]:
    """Return every numba function in the package's loaded modules."""
    modules = [module for name, module in list(sys.modules.items()) if name.startswith("msdgs_serve")]
    found = {id(value): value for module in modules for value in vars(module).values() if isinstance(value, Dispatcher)}
    return list(found.values())


def compiled() -> int:
    """Return the number of compiled versions of kernels, one for each combination of argument types."""
    return sum(len(kernel.signatures) for kernel in kernels())


def bytes_of(image: Rendering) -> list[bytes]:
    return [channel.tobytes() for channel in image]


@pytest.mark.parametrize("threads", ["1", "2", "3", "7"])
def test_same_bytes_for_any_number_of_threads(threads: str, monkeypatch: pytest.MonkeyPatch):
    """The size of the pool is fixed by its first use; the work is split by the current number."""
    gaussians, camera = random_scene(41, 500, 150, 90)
    expected = bytes_of(draw(gaussians, camera))
    monkeypatch.setenv("MSDGS_THREADS", threads)
    assert bytes_of(draw(gaussians, camera)) == expected


@pytest.mark.parametrize("threads", ["1", "2", "3", "7"])
def test_sorted_in_parts_the_lists_are_the_same(threads: str, monkeypatch: pytest.MonkeyPatch):
    """As for many splats, on which several threads work."""
    gaussians, camera = random_scene(41, 500, 150, 90)
    expected = bytes_of(draw(gaussians, camera))
    sizes: list[int] = []
    parts_of = tiles._parts

    def counted(count: int) -> list[tuple[int, int]]:
        sizes.append(len(parts_of(count)))
        return parts_of(count)

    monkeypatch.setattr(tiles, "SPLATS_PER_PART", 50)
    monkeypatch.setattr(tiles, "_parts", counted)
    monkeypatch.setenv("MSDGS_THREADS", threads)
    assert bytes_of(draw(gaussians, camera)) == expected
    assert max(sizes) == int(threads)


@pytest.mark.slow
def test_second_process_compiles_nothing():
    """The first leaves its kernels in the cache on disk; the second finds all of them there."""
    draw(*random_scene(40, 12, 19, 13))
    hits, misses = map(int, run_python(COUNT_COMPILATIONS).split())
    assert misses == 0
    assert hits > 0


def read_only(array: np.ndarray) -> np.ndarray:
    array = array.copy()
    array.flags.writeable = False
    return array


@pytest.mark.parametrize("layout", [np.asfortranarray, read_only, lambda a: np.repeat(a, 2, axis=0)[::2]])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_no_layout_of_arrays_is_compiled_separately(layout, dtype: type):
    gaussians, camera = random_scene(43, 20)
    gaussians = as_dtype(gaussians, dtype)
    expected = bytes_of(draw(gaussians, camera))
    laid_out = Gaussians(**{name: layout(getattr(gaussians, name)) for name in FIELDS})
    before = compiled()
    assert bytes_of(draw(laid_out, camera)) == expected
    assert compiled() == before


def test_cameras_of_any_number_type_are_compiled_for_once():
    """Fields may be integers from JSON or NumPy scalars."""
    gaussians, camera = random_scene(43, 20)
    square = replace(camera, fx=50.0, fy=50.0, cx=26.0, cy=18.0)
    expected = bytes_of(draw(gaussians, square))
    for kind in (int, np.float32, np.int64):
        typed = replace(camera, fx=kind(50), fy=kind(50), cx=kind(26), cy=kind(18), width=np.int32(53))  # pyright: ignore
        before = compiled()
        assert bytes_of(draw(gaussians, typed)) == expected
        assert compiled() == before

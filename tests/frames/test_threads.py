"""Work shared by several threads, which ends if its job is cancelled."""

import threading

import numpy as np
import pytest

from msdgs_serve import threads
from msdgs_serve.rasterizer import rasterize
from msdgs_serve.rasterizer.compositing import TILES_PER_ROUND
from msdgs_serve.rasterizer.view import TILE
from msdgs_serve.render_job import RenderCancelled, RenderJob
from msdgs_serve.threads import THREADS_VARIABLE, checking, run_parallel, run_together
from tests.support.scenes import front_camera, gaussians_of


@pytest.fixture
def two_threads(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv(THREADS_VARIABLE, "2")
    monkeypatch.setattr(threads, "_pool", None)


def test_a_part_that_another_thread_has_is_waited_for(two_threads: None):
    caller, begun, ended = threading.get_ident(), threading.Event(), []

    def work() -> bool:
        if threading.get_ident() == caller:
            assert begun.wait(60)
            return False  # the other thread hasn't finished
        begun.set()
        threading.Event().wait(0.1)
        ended.append(True)
        return True

    run_together(work, ())
    assert ended


def test_errors_of_other_threads_are_raised(two_threads: None):
    caller, begun = threading.get_ident(), threading.Event()

    def work() -> bool:
        if threading.get_ident() == caller:
            assert begun.wait(60)
            return False
        begun.set()
        raise MemoryError("no room for a tile")

    with pytest.raises(MemoryError, match="no room"):
        run_together(work, ())


def test_idle_threads_are_not_waited_for(two_threads: None):
    caller, begun, go_on = threading.get_ident(), threading.Event(), threading.Event()

    def work() -> bool:
        if threading.get_ident() != caller:
            begun.set()
            assert go_on.wait(60)
            return True
        return begun.wait(60)

    run_together(work, ())
    assert not go_on.is_set()
    go_on.set()


def test_one_thread_works_alone(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv(THREADS_VARIABLE, "1")
    calls = []
    run_together(lambda *numbers: bool(calls.append((threading.get_ident(), numbers))), (1, 2))
    assert calls == [(threading.get_ident(), (1, 2))]


@pytest.mark.parametrize("threads", ["1", "3"])
def test_parts_on_the_pool_end_with_it(threads: str, monkeypatch: pytest.MonkeyPatch):
    """The running part is finished, later ones are not started."""
    monkeypatch.setenv(THREADS_VARIABLE, threads)
    job, begun = RenderJob(), []

    def part(number: int) -> None:
        begun.append(number)
        job.cancel()

    with pytest.raises(RenderCancelled), job.stage("draw"):
        run_parallel(part, [(number,) for number in range(100)])
    assert 1 <= len(begun) < 10
    run_parallel(part, [(0,)])  # no check outside of the stage


def test_a_large_frame_can_be_given_up_between_its_rounds():
    side = TILE * int(np.sqrt(3 * TILES_PER_ROUND))
    gaussians, camera = gaussians_of([[0, 0, 2]]), front_camera(side, side)
    caller, checks = threading.get_ident(), [0]

    def check() -> None:
        """Counts the caller's own call: the number of helpers that start in time is random."""
        checks[0] += threading.get_ident() == caller

    with checking(check):
        rasterize(gaussians, camera)
    last = checks[0]
    checks[0] = 0

    def give_up() -> None:
        check()
        if checks[0] == last and threading.get_ident() == caller:
            raise RenderCancelled("enough")

    with pytest.raises(RenderCancelled), checking(give_up):
        rasterize(gaussians, camera)
    assert checks[0] == last >= 5

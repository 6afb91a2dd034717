"""Cancelled render jobs end, between stages and inside of them."""

import threading

import numpy as np
import pytest

from msdgs_serve.rasterizer import rasterize
from msdgs_serve.rasterizer.compositing import TILES_PER_ROUND
from msdgs_serve.rasterizer.view import TILE
from msdgs_serve.render_job import RenderCancelled, RenderJob
from msdgs_serve.threads import checking, run_parallel
from tests.support.scenes import front_camera, gaussians_of


@pytest.mark.parametrize("threads", ["1", "3"])
def test_parts_on_the_pool_end_with_it(threads: str, monkeypatch: pytest.MonkeyPatch):
    """The part that runs ends by itself, those after it don't begin."""
    monkeypatch.setenv("MSDGS_THREADS", threads)
    job, begun = RenderJob(), []

    def part(number: int) -> None:
        begun.append(number)
        job.cancel()

    with pytest.raises(RenderCancelled), job.stage("draw"):
        run_parallel(part, [(number,) for number in range(100)])
    assert 1 <= len(begun) < 10
    run_parallel(part, [(0,)])  # outside of the stage nothing is checked


def test_a_large_frame_can_be_given_up_between_its_rounds():
    side = TILE * int(np.sqrt(3 * TILES_PER_ROUND))
    gaussians, camera = gaussians_of([[0, 0, 2]]), front_camera(side, side)
    caller, checks = threading.get_ident(), [0]

    def check() -> None:
        """Counts the caller's own: how many helpers begin before all is done is up to chance."""
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

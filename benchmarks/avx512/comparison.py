"""Our frames and the hand-written renderer's in turns, stage by stage."""

import time
from collections.abc import Callable
from typing import Any

from benchmarks.avx512.renderer import Avx512Renderer
from benchmarks.drawers import psnr
from benchmarks.frame_times import Subject, Times, draw_in_stages
from msdgs_serve.rasterizer import GSPLAT, rasterize

LONG_ENOUGH = 0.03
"""Seconds that each draws a scene in a turn. Of one frame of 1 ms a turn the least is the machine's mood."""


class Comparison:
    """Draws all subjects, each with both; a context, which gives the other's memory back."""

    def __init__(self, subjects: list[Subject]) -> None:
        self._subjects, self._renderer = subjects, Avx512Renderer()
        self._psnr = [
            psnr(rasterize(*scene).rgb, self._renderer.draw(*scene, GSPLAT).rgb)
            for scene in ((subject.gaussians, subject.camera) for subject in subjects)
        ]
        self._ours, self._by_hand = [[Times() for _ in subjects] for _ in range(2)]

    def __enter__(self) -> "Comparison":
        return self

    def __exit__(self, *_: object) -> None:
        self._renderer.close()

    def draw_all(self, turn: int) -> None:
        """One turn. Each goes through all subjects by itself, and who begins changes: who draws a scene right after the
        other finds its Gaussians in the caches, which makes the smallest scene's frame a good deal faster."""
        sides = (self._draw_ours, self._draw_by_hand)
        for draw in sides if turn % 2 else sides[::-1]:
            draw()

    def _draw_ours(self) -> None:
        _draw_each(draw_in_stages, self._subjects, self._ours)

    def _draw_by_hand(self) -> None:
        _draw_each(self._draw_one_by_hand, self._subjects, self._by_hand)

    def _draw_one_by_hand(self, subject: Subject, times: Times) -> None:
        drawn = times.time("total", self._renderer.draw, subject.gaussians, subject.camera, GSPLAT)
        stages = drawn.seconds
        times.add("project", stages["project"])
        times.add("bin", stages["sort"] + stages["bin"])
        times.add("composite", stages["composite"])

    def rows(self) -> list[dict[str, Any]]:
        """Milliseconds of both, and the ratio of their shortest frames."""
        rows = []
        for k, subject in enumerate(self._subjects):
            ours, by_hand = self._ours[k].milliseconds(), self._by_hand[k].milliseconds()
            size = [subject.camera.width, subject.camera.height]
            row = {"count": len(subject.gaussians), "size": size, "ours": ours, "by_hand": by_hand}
            ratio = ours["total"]["min"] / by_hand["total"]["min"]
            rows.append(row | {"ratio": ratio, "psnr": self._psnr[k]})
        return rows


def _draw_each(draw: Callable[[Subject, Times], None], subjects: list[Subject], times: list[Times]) -> None:
    for subject, its_times in zip(subjects, times, strict=True):
        end = time.perf_counter() + LONG_ENOUGH
        while True:
            draw(subject, its_times)
            if time.perf_counter() > end:
                break

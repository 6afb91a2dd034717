"""How fast the rasterizer is and where its time goes: stages, work, memory, the machine's limits."""

import json
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from rich.console import Console
from rich.progress import Progress

from benchmarks.measuring import Times, machine
from benchmarks.rasterizer.report import print_tables
from benchmarks.rasterizer.roofline import Roofline
from benchmarks.rasterizer.scenes import Case, file_cases, object_scene, seeded_cases, write_splat
from benchmarks.rasterizer.stages import Gradient, draw_in_stages, draw_scene, memory_of, row_of, work_of
from export.measure.views import GOLDEN
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.rasterizer import rasterize
from msdgs_serve.scene import MsdgsError
from msdgs_train.datasets.common.files import write_text


@dataclass(frozen=True)
class Benchmark:
    """Measure the rasterizer on seeded scenes, files of splats and scene files.

    Everything that is compared takes turns in one process: a machine's speed may drift by a factor of two in an hour,
    so only ratios of one run count, of minima over its repeats. Work (pairs of splat and pixel) is counted apart from
    what is timed. Kernels are compiled before anything is timed. Type one of these:

    python -m benchmarks.rasterizer

    python -m benchmarks.rasterizer --counts 100000 --sizes 800x800 --repeats 5

    python -m benchmarks.rasterizer --gradient --json out/rasterizer.json

    python -m benchmarks.rasterizer --splats bonsai.ply guitar.splat

    python -m benchmarks.rasterizer --counts --scenes network.onnx chosen.onnx --widths 400 800

    Beside it: `benchmarks.rasterizer.renderers` compares with other renderers and other checkouts,
    `benchmarks.rasterizer.constants` tells what each constant costs and buys. Ctrl-C ends the measuring; what has been
    measured is printed and written.
    """

    counts: tuple[int, ...] = (10_000, 100_000, 300_000, 1_000_000)
    """Numbers of Gaussians of the seeded scenes."""
    sizes: tuple[str, ...] = ("400x400", "800x800", "1920x1080")
    """Widths and heights in pixels of their frames."""
    repeats: int = 20
    """Turns that everything takes."""
    seed: int = 0
    gradient: bool = False
    """Time the backward pass too, as training does it."""
    splats: tuple[Path, ...] = ()
    """Files of real splats, of any format that can be imported, to draw at 800x800 beside the seeded scenes."""
    scenes: tuple[Path, ...] = ()
    """Scene files: how long posing and drawing a frame take, each frame at another time."""
    widths: tuple[int, ...] = (400, 800)
    """Widths in pixels of the scene files' frames, from their first camera."""
    json: Path | None = None
    """Write all figures here."""
    check: bool = False
    """Only see that this benchmark works: a small run, and what must hold of its figures."""


class Run:
    """One run of the benchmark: `result` is what has been measured so far."""

    def __init__(self, options: Benchmark, progress: Progress) -> None:
        self.options, self._progress = options, progress
        self._roofline = Roofline()
        self.result: dict[str, Any] = {"machine": {"name": machine()}}

    def measure(self) -> None:
        """All that was asked for, section by section."""
        options = self.options
        if options.counts:
            self._time_stages("frames", seeded_cases(options.counts, options.sizes, options.seed))
        if options.splats:
            self._time_stages("real", file_cases(options.splats))
        if options.scenes:
            self._time_scenes()

    def _turns(self, title: str) -> Iterator[int]:
        """The first is for compiling, loading and warming up, and its times are to be dropped."""
        task = self._progress.add_task(title, total=self.options.repeats + 1)
        for turn in range(self.options.repeats + 1):
            self._roofline.sample()
            self.result["machine"] |= self._roofline.machine._asdict()
            yield turn
            self._progress.advance(task)

    def _time_stages(self, section: str, cases: list[Case]) -> None:
        work, memory = [work_of(case) for case in cases], [memory_of(case) for case in cases]
        gradients = [Gradient(case) for case in cases] if self.options.gradient else []
        times: list[Times] = []
        for turn in self._turns(section):
            times = times if turn > 1 else [Times() for _ in cases]
            for k, case in enumerate(cases):
                draw_in_stages(case, times[k])
                if gradients:
                    gradients[k].draw(times[k])
            if turn:
                figures = zip(cases, times, work, memory, strict=True)
                self.result[section] = [row_of(*row, self._roofline.machine) for row in figures]

    def _time_scenes(self) -> None:
        sessions = {path: DeformationSession(path) for path in self.options.scenes}
        keys = [(path, width) for path in sessions for width in self.options.widths]
        times: dict[tuple[Path, int], Times] = {}
        for turn in self._turns("scene files"):
            times = times if turn > 1 else {key: Times() for key in keys}
            for path, width in keys:
                draw_scene(sessions[path], width, (turn * GOLDEN) % 1, times[path, width])
            scenes = {path: session.scene for path, session in sessions.items()}
            self.result["scenes"] = [
                {
                    "scene": path.name,
                    "plan": scenes[path].metadata.plan,
                    "moving": scenes[path].moving_count,
                    "width": width,
                    "milliseconds": times[path, width].milliseconds(),
                }
                for path, width in keys
            ]


def main(options: Benchmark) -> int:
    """Measure, print, write."""
    if options.check:
        return check()
    console = Console(highlight=False)
    if not console.is_terminal:
        console = Console(highlight=False, width=170)
    with Progress(console=Console(stderr=True), transient=True) as progress:
        run, stopped = Run(options, progress), False
        try:
            run.measure()
        except KeyboardInterrupt:
            stopped = True
        except MsdgsError as error:
            console.print(f"error: {error}", style="red", markup=False)
            return 1
    print_tables(run.result, console)
    if options.json:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        write_text(options.json, json.dumps(run.result, indent=1) + "\n")
    if stopped:
        console.print("stopped: not all was measured")
    return 130 if stopped else 0


def check() -> int:
    """A small run of all parts, through the files that it writes."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        write_splat(folder / "some.splat", object_scene(50, 1))
        (written,) = file_cases((folder / "some.splat",))
        assert np.abs(written.gaussians.opacities - object_scene(50, 1).opacities).max() <= 0.51 / 255
        options = Benchmark(
            (300,),
            ("64x48",),
            repeats=2,
            gradient=True,
            splats=(folder / "some.splat",),
            scenes=(Path("examples/toybench.onnx"),),
            widths=(32,),
            json=folder / "all.json",
        )
        assert main(options) == 0
        assert main(replace(options, splats=(folder / "none.splat",))) == 1
        result = json.loads((folder / "all.json").read_text())
    (row,), (real,), (scene,) = result["frames"], result["real"], result["scenes"]
    assert (row["count"], row["size"], row["repeats"], real["count"], scene["width"]) == (300, [64, 48], 2, 50, 32)
    assert all(0 < times["min"] <= times["median"] for times in row["milliseconds"].values())
    assert 0 < row["blended"] <= row["evaluated"] <= 256 * row["tile_entries"]
    (case,) = seeded_cases((300,), ("64x48",), 0)
    assert row["blended"] == rasterize(case.gaussians, case.camera, counts=True).counts.sum()
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Benchmark)))

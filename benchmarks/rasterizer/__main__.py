"""The speed of the rasterizer: times of its stages, work, memory, and the limits of the machine."""

import json
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from rich.console import Console
from rich.progress import track

from benchmarks.measuring import Times, machine, report_console
from benchmarks.rasterizer.report import stage_table, work_table
from benchmarks.rasterizer.roofline import Roofline
from benchmarks.rasterizer.scenes import Case, file_cases, object_scene, seeded_cases
from benchmarks.rasterizer.stages import Gradient, draw_in_stages, memory_of, row_of, work_of
from msdgs_serve.rasterizer import rasterize
from msdgs_serve.scene import MsdgsError
from msdgs_serve.writing import write_text
from tests.support.splat_files import splat_bytes


@dataclass(frozen=True)
class Benchmark:
    """Measure the rasterizer on seeded scenes and files of splats.

    Everything that is compared takes turns in one process: a machine's speed may drift by a factor of two in an hour,
    so only ratios of minima within one run count. Work (pairs of splat and pixel) is counted separately. Kernels are
    compiled before the first measurement.

    python -m benchmarks.rasterizer

    python -m benchmarks.rasterizer --counts 100000 --sizes 800x800 --repeats 5

    python -m benchmarks.rasterizer --gradient --json out/rasterizer.json

    python -m benchmarks.rasterizer --counts --splats bonsai.ply guitar.splat

    `benchmarks.rasterizer.renderers` compares with other renderers and checkouts, `benchmarks.rasterizer.constants`
    changes the rasterizer's constants. Ctrl-C ends the measurement; complete turns are printed and written.
    """

    counts: tuple[int, ...] = (10_000, 100_000, 300_000, 1_000_000)
    """Numbers of Gaussians of the seeded scenes."""
    sizes: tuple[str, ...] = ("400x400", "800x800", "1920x1080")
    """Widths and heights of their frames in pixels."""
    repeats: int = 20
    """Turns."""
    seed: int = 0
    gradient: bool = False
    """Time the backward pass of training too."""
    splats: tuple[Path, ...] = ()
    """Splat files of any format that can be imported, drawn at 800x800."""
    json: Path | None = None
    """Write all figures to this file."""
    check: bool = False
    """Test this benchmark: a small run, and properties of its figures."""


def measure(cases: list[Case], options: Benchmark) -> tuple[dict[str, Any], bool]:
    """Figures of the machine and of each case, and whether all turns were made."""
    roofline, work, memory = Roofline(), [work_of(case) for case in cases], [memory_of(case) for case in cases]
    gradients = [Gradient(case) for case in cases] if options.gradient else []
    times, turns = [Times() for _ in cases], 0
    try:
        for turn in track(range(options.repeats + 1), "turns", console=Console(stderr=True), transient=True):
            roofline.sample()
            found = [Times() for _ in cases] if turn <= 1 else times  # the first turn compiles and warms up
            for k, case in enumerate(cases):
                draw_in_stages(case, found[k])
                if gradients:
                    gradients[k].draw(found[k])
            times, turns = found, turn
    except KeyboardInterrupt:
        pass
    figures = zip(cases, times, work, memory, strict=True) if turns else ()
    rows = [row_of(*row, roofline.machine) for row in figures]
    return {"machine": {"name": machine(), **roofline.machine._asdict()}, "frames": rows}, turns == options.repeats


def main(options: Benchmark) -> int:
    """Measure, print, write."""
    if options.check:
        return check()
    console = report_console()
    try:
        cases = [*seeded_cases(options.counts, options.sizes, options.seed), *file_cases(options.splats)]
    except MsdgsError as error:
        console.print(f"error: {error}", style="red", markup=False)
        return 1
    result, complete = measure(cases, options)
    limits, rows = result["machine"], result["frames"]
    console.print(limits["name"])
    rates = f"{limits['gflops']:.0f} GFLOP/s of float32 fma, {limits['gigabytes']:.1f} GB/s copied"
    console.print(f"highest rates in this run: {rates}")
    if rows:
        console.print(stage_table(rows), work_table(rows))
    if options.json:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        write_text(options.json, json.dumps(result, indent=1) + "\n")
    if not complete:
        console.print("stopped before the last turn")
    return 0 if complete else 130


def check() -> int:
    """A small run through the files that it writes."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        (folder / "some.splat").write_bytes(splat_bytes(object_scene(50, 1)))
        (written,) = file_cases((folder / "some.splat",))
        assert np.abs(written.gaussians.opacities - object_scene(50, 1).opacities).max() <= 0.51 / 255
        options = Benchmark((300,), ("64x48",), 2, 0, True, (folder / "some.splat",), folder / "all.json")
        assert main(options) == 0
        assert main(replace(options, splats=(folder / "none.splat",))) == 1
        result = json.loads((folder / "all.json").read_text())
    row, real = result["frames"]
    assert (row["count"], row["size"], row["repeats"], real["count"]) == (300, [64, 48], 2, 50)
    assert all(0 < times["min"] <= times["median"] for times in row["milliseconds"].values())
    assert 0 < row["blended"] <= row["evaluated"] <= 256 * row["tile_entries"]
    (case,) = seeded_cases((300,), ("64x48",), 0)
    assert row["blended"] == rasterize(case.gaussians, case.camera, counts=True).counts.sum()
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Benchmark)))

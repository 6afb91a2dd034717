"""Import and start of a large static scene: processor time, peak memory and seconds until the service is ready."""

import os
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import tyro
from plyfile import PlyData, PlyElement

from benchmarks.measuring import machine, report_console, table
from benchmarks.rasterizer.scenes import object_scene
from benchmarks.service.process import service
from msdgs_export.exporters.ply import ply_rows
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.rasterizer.precompile import compile_kernels

OBJECT = 100_000
"""Gaussians per object of the scene."""
SPACING = 4.0
"""Distance of neighboring objects, which are about 2.6 wide, scene units."""
POLL_SECONDS = 0.01
EXPORT = "import sys; from msdgs_export.commands import to_onnx; sys.exit(to_onnx())"


class Cost(NamedTuple):
    """What a process has taken so far (Linux)."""

    processor_seconds: float
    seconds: float
    peak_bytes: int  # resident, pages of mapped files included
    own_bytes: int  # the most that was seen resident at once without pages of files


def main(
    ply: Annotated[Path | None, tyro.conf.Positional] = None,
    count: int = 4_200_000,
    check: bool = False,
) -> int:
    """Import a PLY with `msdgs-export`, start `msdgs-serve` with the scene file, and print what both cost.

    python -m benchmarks.export.large_import

    Args:
        ply: A PLY of another program; by default a field of seeded objects with SH of degree 3 is made.
        count: Gaussians of the seeded scene.
        check: Test this benchmark on a small scene.
    """
    if check:
        return self_test()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        if ply is None:
            write_field(ply := folder / "field.ply", count)
        report(measure(ply, folder / "scene.onnx"), ply, folder / "scene.onnx")
    return 0


def write_field(file: Path, count: int) -> None:
    """Write seeded objects in a square, as a PLY in the layout of INRIA's trainer."""
    sizes = [min(OBJECT, count - start) for start in range(0, count, OBJECT)]
    side, parts = int(np.ceil(np.sqrt(len(sizes)))), []
    for number, size in enumerate(sizes):
        g = object_scene(size, seed=number)
        place = SPACING * np.array([number % side, 0, number // side], np.float32)
        parts.append(ply_rows(replace(g, means=g.means + place)))
    PlyData([PlyElement.describe(np.concatenate(parts), "vertex")], byte_order="<").write(str(file))


def measure(ply: Path, scene: Path) -> dict[str, Cost]:
    """The costs of the import, and of the start of a service whose kernels are compiled before."""
    compile_kernels()
    started = time.perf_counter()
    with subprocess.Popen([sys.executable, "-c", EXPORT, str(ply), "-o", str(scene)]) as process:
        imported = watched(process, started)
    if process.returncode:
        raise SystemExit(f"the import ended with {process.returncode}")
    started = time.perf_counter()
    with service(scene) as running:
        return {"import": imported, "start of the service": cost_of(running.process.pid, started)}


def watched(process: subprocess.Popen, started: float) -> Cost:
    """The cost of a process until it ends, seen every few milliseconds."""
    cost, own_bytes = Cost(0.0, 0.0, 0, 0), 0
    while process.poll() is None:
        with suppress(OSError, KeyError):  # it ends at this moment
            cost = cost_of(process.pid, started)
            own_bytes = max(own_bytes, cost.own_bytes)
        time.sleep(POLL_SECONDS)
    return cost._replace(own_bytes=own_bytes)


def cost_of(process: int, started: float) -> Cost:
    """What a process has taken since it started."""
    folder = Path(f"/proc/{process}")
    status = dict(line.split(":", 1) for line in (folder / "status").read_text().splitlines())
    user, system = (folder / "stat").read_text().rsplit(")", 1)[1].split()[11:13]
    peak, own = (1024 * int(status[name].split()[0]) for name in ("VmHWM", "RssAnon"))
    return Cost((int(user) + int(system)) / os.sysconf("SC_CLK_TCK"), time.perf_counter() - started, peak, own)


def report(costs: dict[str, Cost], ply: Path, scene: Path) -> None:
    """Print a row per step."""
    sizes = f"{ply.stat().st_size / 1e6:,.0f} MB as PLY, {scene.stat().st_size / 1e6:,.0f} MB as scene file"
    made = table(sizes, "step", "processor, s", "time, s", "peak memory, GB", "without mapped files, GB")
    for name, cost in costs.items():
        figures = (cost.processor_seconds, cost.seconds, cost.peak_bytes / 1e9, cost.own_bytes / 1e9)
        made.add_row(name, *(f"{figure:.2f}" for figure in figures))
    report_console().print(machine(), made)


def self_test() -> int:
    """A field of three objects is imported and served whole."""
    with tempfile.TemporaryDirectory() as folder:
        ply, scene = Path(folder) / "field.ply", Path(folder) / "scene.onnx"
        write_field(ply, 2 * OBJECT + 100)
        costs = measure(ply, scene)
        assert len(DeformationSession(scene).scene) == 2 * OBJECT + 100
        assert all(min(cost) > 0 for cost in costs.values())
        report(costs, ply, scene)
    return 0


if __name__ == "__main__":
    sys.exit(tyro.cli(main))

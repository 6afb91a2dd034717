"""What deformation and drawing take of a frame, of scene files in turns, at several image sizes."""

import statistics
import sys
import time
from collections import defaultdict
from pathlib import Path
from typing import Annotated

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import tyro
from rich.console import Console
from rich.table import Table

from export.measure.views import GOLDEN
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.rasterizer import as_trained, rasterize
from msdgs_serve.scene.errors import MsdgsError


def main(
    scenes: Annotated[list[Path], tyro.conf.Positional], sizes: tuple[int, ...] = (400, 800), repeats: int = 9
) -> int:
    """Time frames of scene files, one of each in turn, so that a busy moment of the machine hits all alike.

    python benchmarks/deformation_share.py network.onnx chosen.onnx --sizes 400 800

    Args:
        scenes: Files of contract msdgs/1 with at least one camera.
        sizes: Widths of images in pixels; the scene's first camera is scaled to them.
        repeats: Frames of each file and size, at other times each.
    """
    console = Console(soft_wrap=True, highlight=False)
    try:
        sessions = {path: DeformationSession(path) for path in scenes}
    except MsdgsError as error:
        console.print(f"error: {error}", style="red", markup=False)
        return 1
    found: dict[tuple[Path, int], list[tuple[float, float]]] = defaultdict(list)
    for turn in range(repeats + 1):
        for path, session in sessions.items():
            for size in sizes:
                lap = _lap(session, size, (turn * GOLDEN) % 1)
                found[path, size] += [lap] if turn else []  # the first frames load and compile
    table = Table("scene", "plan", "moving", "image", "deform ms, min", "median", "draw ms, min", "median", box=None)
    for (path, size), laps in found.items():
        scene = sessions[path].scene
        parts = [f"{f(part):.1f}" for part in zip(*laps, strict=True) for f in (min, statistics.median)]
        table.add_row(path.name, scene.metadata.plan, f"{scene.moving_count:,}", f"{size} wide", *parts)
    console.print(table)
    return 0


def _lap(session: DeformationSession, width: int, part: float) -> tuple[float, float]:
    """Milliseconds that posing and drawing a frame at a part of the whole time take."""
    metadata = session.scene.metadata
    t0, t1 = metadata.time_range
    stored = metadata.cameras[0].camera
    camera = stored.resized(width, max(1, round(stored.height * width / stored.width)))
    start = time.perf_counter()
    gaussians = session.gaussians(t0 + (t1 - t0) * part)
    posed = time.perf_counter()
    rasterize(gaussians, camera, background=metadata.background, options=as_trained(metadata))
    return 1e3 * (posed - start), 1e3 * (time.perf_counter() - posed)


if __name__ == "__main__":
    sys.exit(tyro.cli(main))

"""Frames of a camera that stands still: those of a sequence relative to whole frames, by how much moves."""

import sys
import time
from dataclasses import dataclass, replace

import numpy as np
import tyro
from rich.console import Console
from rich.progress import track

from benchmarks.measuring import Times, machine, minimum_and_median, report_console, table
from benchmarks.rasterizer.scenes import object_camera, object_scene
from msdgs_serve.rasterizer import FrameSequence, rasterize
from msdgs_serve.scene import Gaussians

SHIFTS = 8
"""Times of a sequence; between them the moving Gaussians are shifted by up to a twentieth of the object's diameter."""


@dataclass(frozen=True)
class StillCamera:
    """Draw frames of seeded scenes of which a fraction of the Gaussians moves, in turns: whole, and by a sequence that
    has drawn the static ones before. The moving ones are those on one side, as an object of its own would be. Frames
    are compared bit by bit. Times are processor times of all threads, which hardly depend on other programs; `wall`
    measures time that passes instead.

    python -m benchmarks.rasterizer.still_camera
    """

    count: int = 100_000
    """Number of Gaussians."""
    fractions: tuple[float, ...] = (0.01, 0.1, 0.25, 0.5, 0.75, 0.95)
    """Fractions that move."""
    size: tuple[int, int] = (800, 800)
    """Width and height in pixels."""
    seed: int = 0
    repeats: int = 5
    """Turns of `SHIFTS` frames each."""
    wall: bool = False
    """Measure the time that passes."""
    check: bool = False
    """Test this benchmark on a small scene."""


def divided(count: int, fraction: float, seed: int) -> tuple[Gaussians, Gaussians]:
    """Moving and static Gaussians of a seeded scene."""
    scene = object_scene(count, seed)
    order = np.argsort(scene.means[:, 0], kind="stable")
    moving = round(fraction * count)
    one, other = (
        Gaussians(**{name: array[rows] for name, array in vars(scene).items()})
        for rows in (order[:moving], order[moving:])
    )
    return one, other


def joined(moving: Gaussians, static: Gaussians) -> Gaussians:
    """All Gaussians, as a scene file poses them."""
    arrays = vars(moving).items()
    return Gaussians(**{name: np.concatenate([array, getattr(static, name)]) for name, array in arrays})


def main(options: StillCamera) -> int:
    """Draw in turns, print the table."""
    if options.check:
        return main(replace(options, count=3_000, size=(64, 48), repeats=1, check=False))
    camera, clock = object_camera(*options.size), time.perf_counter if options.wall else time.process_time
    made = table(
        f"{options.count:,} Gaussians, {options.size[0]}×{options.size[1]}, ms per frame ({clock.__name__})",
        *("moving", "tiles touched", "whole", "sequence", "whole / sequence", "start of a sequence"),
    )
    for fraction in track(options.fractions, "fractions", console=Console(stderr=True), transient=True):
        moving, static = divided(options.count, fraction, options.seed)
        shifts = np.random.default_rng(options.seed).uniform(-0.1, 0.1, (SHIFTS, 3)).astype(np.float32)
        posed = [replace(moving, means=moving.means + shift) for shift in shifts]
        scenes, times, touched = [joined(each, static) for each in posed], Times(clock), 0.0
        for turn in range(options.repeats + 1):
            found = times if turn else Times(clock)  # the first turn compiles and warms up
            sequence = found.time("start", FrameSequence, static, len(moving), camera)
            for scene, each in zip(scenes, posed, strict=True):
                whole, frame = found.time("whole", rasterize, scene, camera), found.time("frame", sequence.frame, each)
                if not np.array_equal(whole.rgb, frame.rgb):
                    raise AssertionError(f"frames differ with {fraction:g} moving")
                touched = sequence.touched
        shown = {name: minimum_and_median(value) for name, value in times.milliseconds().items()}
        ratio = times.minimum("whole") / times.minimum("frame")
        row = (f"{fraction:.0%}", f"{touched:.0%}", shown["whole"], shown["frame"], f"{ratio:.2f}", shown["start"])
        made.add_row(*row)
    report_console().print(machine(), made)
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(StillCamera)))

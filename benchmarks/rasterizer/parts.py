"""Frames of which a part is drawn, or whose camera sees a part of the scene: times relative to those without help."""

import sys
import time
from dataclasses import dataclass, replace

import numpy as np
import tyro
from rich.console import Console
from rich.progress import track

from benchmarks.measuring import Times, machine, minimum_and_median, report_console, table
from benchmarks.rasterizer.scenes import object_camera, object_scene
from msdgs_export.spatial_order import morton_order
from msdgs_serve.rasterizer import GSPLAT, rasterize
from msdgs_serve.rasterizer.projection import project
from msdgs_serve.rasterizer.view import in_tiles
from msdgs_serve.scene import Camera, Gaussians, Region
from msdgs_serve.scene.static_bounds import StaticBounds, static_bounds

CLOSE_UP_FOCAL = 3.5
"""Factor of the focal length, at which about a tenth of the Gaussians are in the image."""
REGION = 0.25
"""Side of a region, as a fraction of the image's."""


@dataclass(frozen=True)
class Parts:
    """Draw seeded static scenes in the order of scene files, in turns: the whole view, a close-up, and a region in its
    middle, each with and without the bounds of static Gaussians. Times are processor times of all threads, which hardly
    depend on other programs.

    python -m benchmarks.rasterizer.parts
    """

    counts: tuple[int, ...] = (100_000, 1_000_000)
    """Numbers of Gaussians."""
    size: tuple[int, int] = (800, 800)
    """Width and height in pixels."""
    seed: int = 0
    repeats: int = 20
    """Turns."""
    check: bool = False
    """Test this benchmark on a small scene."""


def ordered_scene(count: int, seed: int) -> tuple[Gaussians, StaticBounds]:
    """A seeded scene along a space-filling curve, and its bounds."""
    scene = object_scene(count, seed)
    order = morton_order(scene.means)
    scene = Gaussians(**{name: array[order] for name, array in vars(scene).items()})
    return scene, static_bounds(0, scene.means, scene.scales)


def views(camera: Camera) -> dict[str, tuple[Camera, Region | None]]:
    """Cameras and regions by name."""
    close = replace(camera, fx=CLOSE_UP_FOCAL * camera.fx, fy=CLOSE_UP_FOCAL * camera.fy)
    width, height = (round(REGION * side) for side in (camera.width, camera.height))
    middle = Region((camera.width - width) // 2, (camera.height - height) // 2, width, height)
    return {"whole view": (camera, None), "close-up": (close, None), "region": (camera, middle)}


def draw(scene: Gaussians, camera: Camera, region: Region | None, bounds: StaticBounds | None) -> np.ndarray:
    """[H, W, 3] a frame or a part of it."""
    return rasterize(scene, camera, region=region, static=bounds).rgb


def main(options: Parts) -> int:
    """Draw in turns, print the table."""
    if options.check:
        return main(replace(options, counts=(3_000,), size=(64, 48), repeats=2, check=False))
    made = table(
        f"{options.size[0]}×{options.size[1]}, a region of {REGION:g} of each side",
        *("Gaussians", "view", "seen", "without bounds, ms", "with bounds, ms", "with / without", "with / whole view"),
    )
    for count in options.counts:
        scene, bounds = ordered_scene(count, options.seed)
        cases, times = views(object_camera(*options.size)), Times(time.process_time)
        for turn in track(range(options.repeats + 1), f"{count:,}", console=Console(stderr=True), transient=True):
            found = times if turn else Times()  # the first turn compiles and warms up
            for name, (camera, region) in cases.items():
                without = found.time(name, draw, scene, camera, region, None)
                with_bounds = found.time(f"{name}, bounds", draw, scene, camera, region, bounds)
                if not np.array_equal(without, with_bounds):
                    raise AssertionError(f"{name} of {count:,} Gaussians differs")
        shown, whole = times.milliseconds(), times.minimum("whole view")
        for name, (camera, region) in cases.items():
            tiles = None if region is None else in_tiles(region, camera)
            seen = project(scene, camera, GSPLAT, tiles).visible / count
            without, with_bounds = times.minimum(name), times.minimum(f"{name}, bounds")
            made.add_row(
                *(f"{count:,}", name, f"{seen:.0%}"),
                *(minimum_and_median(shown[key]) for key in (name, f"{name}, bounds")),
                *(f"{with_bounds / without:.2f}", f"{with_bounds / whole:.2f}"),
            )
    report_console().print(machine(), made)
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Parts)))

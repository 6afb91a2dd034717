"""The page's own drawing in a browser: PSNR to the service's frames, and time beside Spark and PlayCanvas."""

import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro
from playwright.sync_api import Browser

from benchmarks.browser.pages import RENDERERS, Scene, around, opened, pages
from benchmarks.browser.scenes import copied, fading, imported, static
from benchmarks.measuring import Times, machine, minimum_and_median, psnr, report_console, table
from msdgs_serve.renderer import Renderer
from tests.support.processes import ROOT

MIN_PSNR = 40.0
MAX_RATIO = 1.2
TURN = 0.5
"""Degrees between frames of a moving camera."""


@dataclass(frozen=True)
class Compare:
    """Draw scene files in headless Chromium.

    make benchmarks/browser/node_modules && python -m benchmarks.browser --splats some.ply

    Chromium draws by SwiftShader, on the processor: only ratios mean anything. The exit status is 1 if a frame is below
    40 dB to the service's, or if ours takes more than 1.2 times as long as the faster of the others. Times are minima
    and, in parentheses, medians; renderers take turns.
    """

    scene: Path = ROOT / "examples" / "toys.onnx"
    """A scene file that moves."""
    splats: Path | None = None
    """A splat file; otherwise a seeded one."""
    views: int = 20
    """Cameras and times of each of three scenes."""
    count: int = 100_000
    """Gaussians of the frames that are timed, SH of degree 3."""
    size: tuple[int, int] = (400, 300)
    """Of all frames, in pixels."""
    turns: int = 3
    """Of each renderer."""
    frames: int = 8
    """Per turn."""
    seed: int = 0
    only: tuple[Literal["quality", "speed"], ...] = ("quality", "speed")
    """Compare these."""
    check: bool = False
    """Test this benchmark at small sizes, without judging times."""


def main(options: Annotated[Compare, tyro.conf.arg(name="")]) -> int:
    """Compare, and print tables."""
    if options.check:
        options = Compare(views=1, count=2000, size=(96, 64), turns=1, frames=2, check=True)
    console = report_console()
    console.print(machine())
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        with pages(folder) as (browser, address):
            near = "quality" not in options.only or quality(browser, address, scenes_of(options, folder), options)
            splats = static(folder, options.count, options.seed)
            fast = "speed" not in options.only or speed(browser, address, splats, options)
    return 0 if near and (fast or options.check) else 1


def scenes_of(options: Compare, folder: Path) -> list[Scene]:
    """A scene that moves, a static one, and one whose opacities depend on time."""
    count = min(options.count, 10_000)
    still = imported(folder, options.splats) if options.splats else static(folder, count, options.seed)
    return [copied(folder, options.scene), still, fading(folder, count, options.seed)]


def quality(browser: Browser, address: str, scenes: list[Scene], options: Compare) -> bool:
    """Print the PSNR between our page's frames and the service's. Return whether all are near enough."""
    columns = "scene", "Gaussians", "worst, dB", "median, dB", "memory, MB"
    report = table(f"PSNR to the service, {options.views} views", *columns)
    rng, renderer, worst = np.random.default_rng(options.seed), Renderer(), np.inf
    for scene in scenes:
        first, last = scene.session.scene.metadata.time_range
        found = []
        with opened(browser, address, "msdgs", scene, options.size) as page:
            for _ in range(options.views):
                angles = rng.uniform(0, 360), rng.uniform(-60, 60), rng.uniform(0.6, 1.2)
                camera, t = around(scene.session, options.size, *angles), rng.uniform(first, last)
                frame = renderer.render(scene.session, camera, t).display_pixels() / 255
                found.append(psnr(page.image(camera, t), frame))
            megabytes = page.megabytes()
        worst = min(worst, *found)
        count = f"{len(scene.session.scene):,}"
        report.add_row(scene.file.stem, count, f"{min(found):.1f}", f"{np.median(found):.1f}", f"{megabytes:.0f}")
    report_console().print(report)
    return worst >= MIN_PSNR


def speed(browser: Browser, address: str, scene: Scene, options: Compare) -> bool:
    """Print times of frames of a camera that turns. Return whether ours are short enough."""
    cameras = [around(scene.session, options.size, TURN * k, 20.0) for k in range(options.frames)]
    wanted = Renderer().render(scene.session, cameras[0], 0.0).display_pixels() / 255
    times, main_thread, others = Times(), Times(), {}
    for _ in range(options.turns):
        for name in RENDERERS:
            with opened(browser, address, name, scene, options.size) as page:
                near = psnr(page.image(cameras[0], 0.0), wanted)
                for frame in page.moving(cameras):
                    times.add(name, frame["all"] / 1000)
                    main_thread.add(name, frame["main"] / 1000)
                others[name] = near, page.megabytes()
    best, main_best = times.milliseconds(), main_thread.milliseconds()
    ratios = {name: best[name]["min"] / best["msdgs"]["min"] for name in RENDERERS}
    width, height = options.size
    title = f"{options.count:,} Gaussians at {width}×{height}"
    report = table(title, "page", "frame, ms", "ratio to ours", "main thread, ms", "memory, MB", "PSNR, dB")
    for name in RENDERERS:
        near, megabytes = others[name]
        figures = minimum_and_median(best[name]), f"{ratios[name]:.2f}", minimum_and_median(main_best[name])
        report.add_row(name, *figures, f"{megabytes:.0f}", f"{near:.1f}")
    report_console().print(report)
    return min(ratios.values()) * MAX_RATIO >= 1


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Compare)))

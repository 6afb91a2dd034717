"""The rasterizer's constants, changed one at a time: error against float64, and time."""

import sys
import time
from dataclasses import dataclass, replace
from functools import partial
from unittest import mock

import numpy as np
import tyro
from rich.console import Console
from rich.progress import track

from benchmarks.measuring import Times, machine, minimum_and_median, psnr, report_console, table
from benchmarks.rasterizer.scenes import SH_DEGREE, object_camera, object_scene
from msdgs_serve.rasterizer import GSPLAT, RasterizerOptions, alpha, rasterize
from msdgs_serve.rasterizer.simd.exponential import exp2_polynomial
from msdgs_serve.scene import Camera, Gaussians
from tests.support.reference import render

WITHOUT_THRESHOLDS = GSPLAT._replace(alpha_min=1e-6, transmittance_min=0.0)


@dataclass(frozen=True)
class Constants:
    """Draw one seeded scene with each constant changed in turn, in a new random order each turn.

    python -m benchmarks.rasterizer.constants

    Times are processor times of all threads, which hardly depend on other programs. Errors are against float64 with
    the default constants, and against float64 without thresholds (alpha 1e-6, transmittance 0).
    """

    count: int = 100_000
    """Number of Gaussians."""
    size: tuple[int, int] = (800, 800)
    """Width and height in pixels."""
    seed: int = 0
    repeats: int = 60
    """Turns."""
    check: bool = False
    """Test this benchmark on a small scene."""


def draw(
    gaussians: Gaussians,
    camera: Camera,
    options: RasterizerOptions = GSPLAT,
    exp2_degree: int = 5,
    sh_degree: int = SH_DEGREE,
) -> np.ndarray:
    """[H, W, 3] a frame with other options, another polynomial for 2^x, or fewer SH bands."""
    sh = np.ascontiguousarray(gaussians.sh[:, : (sh_degree + 1) ** 2])
    with mock.patch.object(alpha, "exp2_polynomial", return_value=exp2_polynomial(exp2_degree)):
        return rasterize(replace(gaussians, sh=sh), camera, options=options).rgb


VARIANTS = {
    ("default", ""): draw,
    **{("α ≥", f"{a:g}/255"): partial(draw, options=GSPLAT._replace(alpha_min=a / 255)) for a in (0.25, 0.5, 2, 4)},
    **{("T >", f"{t:g}"): partial(draw, options=GSPLAT._replace(transmittance_min=t)) for t in (0.0, 1e-5, 1e-3, 1e-2)},
    **{("degree of 2^x", f"{degree}"): partial(draw, exp2_degree=degree) for degree in (3, 4, 6, 7)},
    **{("degree of harmonics", f"{degree}"): partial(draw, sh_degree=degree) for degree in (2, 1, 0)},
}
"""Ways to draw, by constant and value."""


def as_float64(gaussians: Gaussians) -> Gaussians:
    return Gaussians(**{name: array.astype(np.float64) for name, array in vars(gaussians).items()})


def agreement_with_reference(seed: int) -> float:
    """Largest difference between the float64 rasterizer and the slow reference of the tests, on a small scene."""
    scene, camera = as_float64(object_scene(1000, seed)), object_camera(96, 80)
    return float(np.abs(rasterize(scene, camera).rgb - render(scene, camera).rgb).max())


def main(options: Constants) -> int:
    """Draw in turns, print the table."""
    if options.check:
        assert agreement_with_reference(0) < 1e-12
        return main(Constants(300, (64, 48), repeats=2))
    scene, camera = object_scene(options.count, options.seed), object_camera(*options.size)
    reference = rasterize(as_float64(scene), camera).rgb
    unlimited = rasterize(as_float64(scene), camera, options=WITHOUT_THRESHOLDS).rgb
    images = [variant(scene, camera) for variant in VARIANTS.values()]
    known, times, rng = list(VARIANTS.values()), Times(time.process_time), np.random.default_rng(0)
    for _ in track(range(options.repeats), "turns", console=Console(stderr=True)):
        for k in rng.permutation(len(known)):
            times.time(str(k), known[k], scene, camera)
    made = table(
        f"{options.count:,} Gaussians, {options.size[0]}×{options.size[1]}, one constant changed at a time",
        *("constant", "value", "processor ms", "relative", "dB to float64", "worst pixel"),
        "dB to float64 without thresholds",
    )
    for k, (name, image) in enumerate(zip(VARIANTS, images, strict=True)):
        ratio = f"{times.minimum(str(k)) / times.minimum('0'):.2f}"
        errors = f"{psnr(image, reference):.1f}", f"{np.abs(image - reference).max():.1e}"
        milliseconds = minimum_and_median(times.milliseconds()[str(k)])
        made.add_row(*name, milliseconds, ratio, *errors, f"{psnr(image, unlimited):.1f}")
    console = report_console()
    console.print(machine(), made)
    difference = agreement_with_reference(options.seed)
    console.print(f"float64 against tests/support/reference.py on a small scene: largest difference {difference:.1e}")
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Constants)))

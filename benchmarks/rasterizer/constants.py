"""What each constant of the rasterizer costs and buys: error against float64, and time, one changed at a time."""

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple
from unittest import mock

import numpy as np
import tyro
from rich.console import Console
from rich.progress import track

from benchmarks.measuring import Times, machine, minimum_and_median, psnr
from benchmarks.rasterizer.report import table
from benchmarks.rasterizer.scenes import object_camera, object_scene
from msdgs_serve.rasterizer import GSPLAT, RasterizerOptions, alpha, rasterize
from msdgs_serve.rasterizer.exponential import exp2_polynomial
from msdgs_serve.scene import Camera, Gaussians
from tests.support.reference import render

WITHOUT_THRESHOLDS = GSPLAT._replace(alpha_min=1e-6, transmittance_min=0.0)
ALPHAS, TRANSMITTANCES = (0.25, 0.5, 2, 4), (0.0, 1e-5, 1e-3, 1e-2)  # alphas in 1/255


@dataclass(frozen=True)
class Constants:
    """Draw one seeded scene with each constant changed in turn, in another order each turn.

    python -m benchmarks.rasterizer.constants

    Times are those of the processor, all threads together: waiting for other programs would hide what a constant costs.
    Errors are against float64 with the usual constants, and against float64 without any threshold (alpha 1e-6,
    transmittance 0).
    """

    count: int = 100_000
    """Gaussians."""
    size: tuple[int, int] = (800, 800)
    """Width and height in pixels."""
    seed: int = 0
    repeats: int = 60
    """Turns."""
    check: bool = False
    """Only see that this benchmark works, on a small scene."""


class Variant(NamedTuple):
    """One way to draw."""

    constant: str
    value: str
    draw: Callable[[Gaussians, Camera], np.ndarray]  # to rgb [H, W, 3]


def variants() -> list[Variant]:
    """The first is how frames are drawn."""
    return [
        Variant("as it is", "", with_options(GSPLAT)),
        *(Variant("α ≥", f"{a:g}/255", with_options(GSPLAT._replace(alpha_min=a / 255))) for a in ALPHAS),
        *(Variant("T >", f"{t:g}", with_options(GSPLAT._replace(transmittance_min=t))) for t in TRANSMITTANCES),
        *(Variant("degree of 2^x", str(degree), with_polynomial(degree)) for degree in (3, 4, 6, 7)),
        *(Variant("degree of harmonics", str(degree), with_harmonics(degree)) for degree in (2, 1, 0)),
    ]


def with_options(options: RasterizerOptions) -> Callable[[Gaussians, Camera], np.ndarray]:
    return lambda gaussians, camera: rasterize(gaussians, camera, options=options).rgb


def with_polynomial(degree: int) -> Callable[[Gaussians, Camera], np.ndarray]:
    """2^x of another degree in the compositing."""

    def draw(gaussians: Gaussians, camera: Camera) -> np.ndarray:
        with mock.patch.object(alpha, "exp2_polynomial", return_value=exp2_polynomial(degree)):
            return rasterize(gaussians, camera).rgb

    return draw


def with_harmonics(degree: int) -> Callable[[Gaussians, Camera], np.ndarray]:
    """None above a degree."""

    def draw(gaussians: Gaussians, camera: Camera) -> np.ndarray:
        sh = np.ascontiguousarray(gaussians.sh[:, : (degree + 1) ** 2])
        return rasterize(replace(gaussians, sh=sh), camera).rgb

    return draw


def as_float64(gaussians: Gaussians) -> Gaussians:
    g = gaussians
    return Gaussians(*(array.astype(np.float64) for array in (g.means, g.quats, g.scales, g.opacities, g.sh)))


def agreement_with_reference(seed: int) -> float:
    """Largest difference between our float64 and the slow, obvious renderer of the tests, on a small scene."""
    scene, camera = as_float64(object_scene(1000, seed)), object_camera(96, 80)
    return float(np.abs(rasterize(scene, camera).rgb - render(scene, camera).rgb).max())


def main(options: Constants) -> int:
    """Draw in turns, print the table."""
    if options.check:
        return check()
    console = Console(highlight=False, width=None if sys.stdout.isatty() else 170)
    scene, camera = object_scene(options.count, options.seed), object_camera(*options.size)
    exact, known = as_float64(scene), variants()
    reference = rasterize(exact, camera).rgb
    unlimited = rasterize(exact, camera, options=WITHOUT_THRESHOLDS).rgb
    images, times = [variant.draw(scene, camera) for variant in known], Times(time.process_time)
    rng = np.random.default_rng(0)
    for _ in track(range(options.repeats), "turns", console=Console(stderr=True)):
        for k in rng.permutation(len(known)):
            times.time(str(k), known[k].draw, scene, camera)
    made = table(
        f"{options.count:,} Gaussians, {options.size[0]}×{options.size[1]}, one constant changed at a time",
        *("constant", "value", "processor ms", "of usual", "dB to float64", "worst pixel"),
        "dB to float64 without thresholds",
    )
    for k, (variant, image) in enumerate(zip(known, images, strict=True)):
        ratio = f"{times.minimum(str(k)) / times.minimum('0'):.2f}"
        worst = f"{np.abs(image - reference).max():.1e}"
        errors = f"{psnr(image, reference):.1f}", worst, f"{psnr(image, unlimited):.1f}"
        made.add_row(variant.constant, variant.value, minimum_and_median(times.milliseconds()[str(k)]), ratio, *errors)
    console.print(machine(), made)
    difference = agreement_with_reference(options.seed)
    console.print(f"float64 against tests/reference.py on a small scene: {difference:.1e} at most")
    return 0


def check() -> int:
    """Float64 against the reference, then a small run."""
    assert agreement_with_reference(0) < 1e-12
    return main(Constants(300, (64, 48), repeats=2))


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Constants)))

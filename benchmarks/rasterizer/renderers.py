"""This rasterizer and others in turns: times, and the PSNR between their images."""

import contextlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, NamedTuple, cast

import numpy as np
import OpenImageIO as oiio
import tyro

from benchmarks.measuring import Times, machine, minimum_and_median, psnr, report_console, table
from benchmarks.rasterizer.avx512 import Avx512Renderer, why_not
from benchmarks.rasterizer.scenes import Case, file_cases, seeded_cases
from benchmarks.rasterizer.stages import STAGES, draw_in_stages
from msdgs_serve.rasterizer import GSPLAT, rasterize
from tests.support.splat_files import splat_bytes

WORKER, ROOT = Path(__file__).with_name("renderer_worker.py"), Path(__file__).resolve().parents[2]
LONG_ENOUGH = 0.03
"""Seconds that each renderer draws a case in a turn: minima over a few frames of 1 ms vary too much."""

NEAREST = {
    # F3D adds 0.3 / size² to a covariance in clip space, in which the image is 2 wide and not 1. It has no threshold of
    # alpha or transmittance, but ends a splat at 3 sigma.
    "F3D": GSPLAT._replace(eps2d=0.3 / 4)
}
"""Options of this rasterizer that are closest to the constants of another renderer, if these aren't gsplat's."""


@dataclass(frozen=True)
class Compare:
    """Draw seeded scenes or files of splats with this rasterizer and others in turns.

    python -m benchmarks.rasterizer.renderers --avx512

    python -m benchmarks.rasterizer.renderers --against ../msdgs-before --counts 100000

    python -m venv .venv-f3d && .venv-f3d/bin/pip install f3d==4.0.0

    python -m benchmarks.rasterizer.renderers --f3d-python .venv-f3d/bin/python --counts 20000 --sizes 400x400

    F3D (https://f3d.app, 80 MB, glibc 2.34 or newer) draws by OpenGL through EGL; without a GPU, Mesa's software does
    (Debian: apt install libegl1 libgl1-mesa-dri). Open3D (https://www.open3d.org, 400 MB, 0.20 or newer) draws by
    Vulkan (apt install mesa-vulkan-drivers libusb-1.0-0). Both read a .splat file (8 bits for color, opacity and
    rotation, SH of degree 0) and are compared with frames of the same file.
    """

    counts: tuple[int, ...] = (100_000, 300_000)
    """Numbers of Gaussians of the seeded scenes."""
    sizes: tuple[str, ...] = ("800x800",)
    """Widths and heights in pixels."""
    splats: tuple[Path, ...] = ()
    """Files of splats to draw, at the first size, instead of the seeded scenes."""
    seed: int = 0
    repeats: int = 5
    """Turns."""
    avx512: bool = False
    """Compare with the renderer written by hand for AVX-512; needs g++ and such a processor."""
    against: Path | None = None
    """Another checkout of this project. Both checkouts run in processes of their own."""
    f3d_python: Path | None = None
    """An interpreter that can import f3d."""
    open3d_python: Path | None = None
    """An interpreter that can import open3d."""
    alpha_min: float = GSPLAT.alpha_min
    """Alpha threshold of the frames that F3D and Open3D are compared with; F3D itself has none."""
    check: bool = False
    """Test this benchmark: this checkout against itself, and AVX-512 if the processor has it."""


class Renderer(NamedTuple):
    """A renderer of one case."""

    draw: Callable[[Times], Any]  # draws a frame; adds its seconds as "total", and those of its stages if known
    image: Callable[[], np.ndarray]  # [H, W, 3]
    version: str = ""


def ours(case: Case) -> Renderer:
    """The rasterizer of this checkout."""
    return Renderer(lambda times: draw_in_stages(case, times), lambda: rasterize(case.gaussians, case.camera).rgb)


def by_hand(renderer: Avx512Renderer, case: Case) -> Renderer:
    """The renderer of avx512.cpp."""

    def draw(times: Times) -> None:
        drawn = times.time("total", renderer.draw, case.gaussians, case.camera, GSPLAT)
        for name, seconds in drawn.seconds.items():
            times.add(name, seconds)

    return Renderer(draw, lambda: renderer.draw(case.gaussians, case.camera, GSPLAT).rgb)


@contextlib.contextmanager
def in_a_process(
    name: str, python: Path | str, case: Case, file: Path, checkout: Path | None = None
) -> Iterator[Renderer]:
    """F3D, Open3D or a checkout of this project, which draws `file` through renderer_worker.py."""
    camera, pose = case.camera, case.camera.camera_to_world
    with tempfile.TemporaryDirectory() as temporary, tempfile.TemporaryFile("w+") as errors:
        image = Path(temporary, "frame.npy" if checkout else "frame.png")
        job = {
            "renderer": "msdgs" if checkout else name,
            "file": str(file),
            "image": str(image),
            "size": [camera.width, camera.height],
            "position": pose[:3, 3].tolist(),
            "focal_point": (pose[:3, 3] + pose[:3, 2]).tolist(),
            "view_up": (-pose[:3, 1]).tolist(),
            "view_angle": float(np.degrees(2 * np.arctan(camera.height / 2 / camera.fy))),
        }
        process = subprocess.Popen(
            [str(python), str(WORKER), json.dumps(job)],
            env={**os.environ, "PYTHONPATH": str(checkout)} if checkout else None,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors, text=True,
        )  # fmt: skip
        orders, answers = cast(IO[str], process.stdin), cast(IO[str], process.stdout)

        def ask(order: str, key: str) -> Any:
            with contextlib.suppress(BrokenPipeError):  # its standard error has the reason
                print(order, end="", file=orders, flush=True)
            for line in answers:
                if line.startswith(f'{{"{key}"'):  # the libraries print too
                    return json.loads(line)[key]
            errors.seek(0)
            raise SystemExit(f"{name} did not draw:\n{errors.read()[-3000:]}")

        def saved() -> np.ndarray:
            ask("save\n", "saved")
            return np.load(image) if checkout else np.asarray(oiio.ImageBuf(str(image)).get_pixels(oiio.FLOAT))[..., :3]

        try:
            version = str(ask("", "version"))
            yield Renderer(lambda times: times.add("total", ask("draw\n", "seconds")), saved, version)
        finally:
            process.kill()
            process.communicate()


def in_turns(renderers: dict[str, Renderer], repeats: int) -> dict[str, Times]:
    """Each renderer draws the case for a while, in alternating order; the first turn loads and compiles."""
    times: dict[str, Times] = {}
    for turn in range(repeats + 1):
        times = times if turn > 1 else {name: Times() for name in renderers}
        for name in list(renderers)[:: 1 if turn % 2 else -1]:
            end = time.perf_counter() + LONG_ENOUGH
            renderers[name].draw(times[name])
            while time.perf_counter() < end:
                renderers[name].draw(times[name])
    return times


def rows_of(case: Case, options: Compare, hand: Avx512Renderer | None) -> Iterator[list[str]]:
    """Rows of the table for one case: this rasterizer, then the others."""
    pythons = {"F3D": options.f3d_python, "Open3D": options.open3d_python}
    checkouts = {"this checkout": ROOT, "the other": options.against.resolve()} if options.against else {}
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        exact, rounded = folder / "exact.npz", folder / "8 bits.splat"
        np.savez(exact, **vars(case.gaussians))
        rounded.write_bytes(splat_bytes(case.gaussians))
        others = {"by hand": by_hand(hand, case)} if hand else {}
        for name, checkout in checkouts.items():  # both in processes of their own, so that nothing else differs
            others[name] = stack.enter_context(in_a_process(name, sys.executable, case, exact, checkout))
        yield from _rows(case, others, options.repeats)
        (coarse,) = file_cases((rounded,))
        coarse = coarse._replace(camera=case.camera)
        others = {n: stack.enter_context(in_a_process(n, p, coarse, rounded)) for n, p in pythons.items() if p}
        yield from _rows(coarse, others, options.repeats, options.alpha_min)


def _rows(
    case: Case, others: dict[str, Renderer], repeats: int, alpha_min: float = GSPLAT.alpha_min
) -> Iterator[list[str]]:
    times = in_turns({"msdgs": ours(case), **others}, repeats) if others else {}
    for name, taken in times.items():
        base, milliseconds = times["this checkout" if name == "the other" else "msdgs"], taken.milliseconds()
        ratio, title, agreement = f"{taken.minimum('total') / base.minimum('total'):.2f}", name, ""
        cells = [minimum_and_median(milliseconds[stage]) if stage in milliseconds else "" for stage in STAGES]
        if name in others:
            nearest = NEAREST.get(name, GSPLAT)._replace(alpha_min=alpha_min)
            db = psnr(rasterize(case.gaussians, case.camera, options=nearest).rgb, others[name].image())
            title = f"{name} {others[name].version}".strip()
            agreement = "same" if db == float("inf") else f"{db:.1f} dB"
        yield [title, case.title(), case.size(), *cells, ratio, agreement]


def main(options: Compare) -> int:
    """Draw in turns, print one table."""
    if options.check:
        return check()
    cases = seeded_cases(options.counts, options.sizes, options.seed)
    if options.splats:
        cases = file_cases(options.splats, *map(int, options.sizes[0].split("x")))
    if not (options.avx512 or options.against or options.f3d_python or options.open3d_python):
        raise SystemExit("nothing to compare with: --avx512, --against, --f3d-python or --open3d-python")
    if options.avx512 and (reason := why_not()):
        raise SystemExit(f"the renderer for AVX-512 can't run: {reason}")
    made = table("Milliseconds, minimum (median)", "renderer", "scene", "size", *STAGES, "× ours", "PSNR to ours")
    with Avx512Renderer() if options.avx512 else contextlib.nullcontext() as hand:
        for row in (row for case in cases for row in rows_of(case, options, hand)):
            made.add_row(*row)
    report_console().print(machine(), made)
    return 0


def check() -> int:
    """Compare this checkout with itself: the images are bit-identical."""
    options = Compare((300,), ("64x48",), repeats=1, against=ROOT, avx512=why_not() is None)
    (case,) = seeded_cases(options.counts, options.sizes, 0)
    agreement = {row[0].split(" /")[0]: row[-1] for row in rows_of(case, options, None)}
    assert agreement == {"msdgs": "", "this checkout": "same", "the other": "same"}
    return main(options)


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Compare)))

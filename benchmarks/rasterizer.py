"""How fast the rasterizer is, where its time goes, and how exact it is."""

import contextlib
import json
import platform
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from rich.console import Console
from rich.progress import Progress
from scipy.optimize import nnls

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.avx512.comparison import Comparison
from benchmarks.avx512.renderer import why_not
from benchmarks.drawers import AS_DRAWN_BY, Drawer, psnr
from benchmarks.frame_times import Gradient, Subject, Times, draw_in_stages, memory_of, row_of, work_of
from benchmarks.rasterizer_knobs import KnobRuns, oracle_agreement
from benchmarks.rasterizer_report import draw_plot, print_tables
from benchmarks.roofline import Roofline
from benchmarks.splat_files import gaussians_of, read_gaussians, records_of
from benchmarks.splat_scenes import around, object_camera, object_scene
from msdgs_serve.rasterizer import rasterize
from msdgs_serve.scene import Camera
from msdgs_serve.threads import thread_count
from msdgs_train.engine.files import write_text

KNOB_COUNT, OTHERS_COUNTS, SQUARE = 100_000, (100_000, 300_000), "800x800"


@dataclass(frozen=True)
class Benchmark:
    """Measure the rasterizer on seeded scenes.

    Everything that is compared takes turns in one process, or in processes side by side: a machine's speed may drift by
    a factor of two in an hour, so only ratios of one run count, of minima over its repeats. Work (pairs of splat and
    pixel) is counted apart from what is timed. Kernels are compiled before anything is timed.

    Type one of these:

    python benchmarks/rasterizer.py
    python benchmarks/rasterizer.py --counts 100000 --sizes 800x800 --repeats 5
    python benchmarks/rasterizer.py --knobs --gradient --json out/rasterizer.json --plot out/rasterizer.png
    python benchmarks/rasterizer.py --f3d-python .venv-f3d/bin/python --open3d-python .venv-open3d/bin/python
    python benchmarks/rasterizer.py --avx512
    python benchmarks/rasterizer.py --against ../msdgs-before
    python benchmarks/rasterizer.py --splats bonsai.ply guitar.splat

    Ctrl-C ends the measuring; what has been measured is printed and written.
    """

    counts: tuple[int, ...] = (10_000, 100_000, 300_000, 1_000_000)
    """Numbers of Gaussians."""
    sizes: tuple[str, ...] = ("400x400", SQUARE, "1920x1080")
    """Widths and heights in pixels."""
    repeats: int = 20
    """Turns that everything takes."""
    seed: int = 0
    gradient: bool = False
    """Time the backward pass too, as training does it; needs torch."""
    knobs: bool = False
    """Error against time for thresholds, degrees and bounds, at 100,000 Gaussians and 800x800."""
    avx512: bool = False
    """The same frames in turns with a renderer written by hand for AVX-512; needs g++ and such a processor."""
    splats: tuple[Path, ...] = ()
    """Files of real splats, .splat or INRIA's .ply, to draw at 800x800 beside the seeded scenes."""
    images: Path | None = None
    """Folder for the images of those."""
    f3d_python: Path | None = None
    """An interpreter that can import f3d: frames of 100,000 and 300,000 Gaussians at 800x800 in turns with ours."""
    open3d_python: Path | None = None
    """The same for open3d, 0.20 or newer. `benchmarks/other_renderers.py --help` says what both need."""
    other_repeats: int = 5
    """Turns with other renderers, which are slow."""
    against: Path | None = None
    """Another checkout of this project: the same frames in turns with this one's."""
    json: Path | None = None
    """Write all figures here."""
    plot: Path | None = None
    """Draw times over the number of Gaussians into this PNG."""


class Run:
    """One run of the benchmark: `result` is what has been measured so far."""

    def __init__(self, options: Benchmark, progress: Progress) -> None:
        self.options, self._progress = options, progress
        self._roofline = Roofline()
        self.result: dict[str, Any] = {"machine": {"cpu": cpu_name(), "threads": thread_count()}}

    def measure(self) -> None:
        """All that was asked for, section by section."""
        options = self.options
        sizes = [tuple(map(int, size.split("x"))) for size in options.sizes]
        subjects = [
            Subject("seeded", scene, object_camera(width, height))
            for scene in (object_scene(count, options.seed) for count in options.counts)
            for width, height in sizes
        ]
        self._time_stages("frames", subjects)
        if options.avx512:
            self._time_avx512(subjects)
        if options.splats:
            real = [Subject(path.name, gaussians := read_gaussians(path), around(gaussians)) for path in options.splats]
            self._time_stages("real", real)
            predict(self.result["real"], self.result["frames"])
            self._save_images(real)
        if options.knobs:
            self._time_knobs()
        pythons = {"F3D": options.f3d_python, "Open3D": options.open3d_python}
        if any(pythons.values()):
            self._time_others({name: python for name, python in pythons.items() if python})
        if options.against:
            self._time_checkouts(options.against)

    def _turns(self, title: str, count: int) -> Iterator[int]:
        """The first is for compiling, loading and warming up, and its times are to be dropped."""
        task = self._progress.add_task(title, total=count + 1)
        for turn in range(count + 1):
            self._roofline.sample()
            self.result["machine"] |= self._roofline.machine._asdict()
            yield turn
            self._progress.advance(task)

    def _time_stages(self, section: str, subjects: list[Subject]) -> None:
        work, memory = [work_of(subject) for subject in subjects], [memory_of(subject) for subject in subjects]
        gradients = [Gradient(subject) for subject in subjects] if self.options.gradient else []
        times: list[Times] = []
        for turn in self._turns(section, self.options.repeats):
            times = times if turn > 1 else [Times() for _ in subjects]
            for k, subject in enumerate(subjects):
                draw_in_stages(subject, times[k])
                if gradients:
                    gradients[k].draw(times[k])
            if turn:
                machine = self._roofline.machine
                self.result[section] = [
                    row_of(*figures, machine) for figures in zip(subjects, times, work, memory, strict=True)
                ]

    def _save_images(self, subjects: list[Subject]) -> None:
        if not self.options.images:
            return
        from matplotlib.image import imsave

        self.options.images.mkdir(parents=True, exist_ok=True)
        for subject in subjects:
            rgb = rasterize(subject.gaussians, subject.camera).rgb
            imsave(self.options.images / f"{subject.name}.png", np.clip(rgb, 0, 1))

    def _time_knobs(self) -> None:
        runs = KnobRuns(object_scene(KNOB_COUNT, self.options.seed), square_camera())
        self.result["oracle_agreement"] = oracle_agreement(self.options.seed)
        for _ in self._turns("knobs", 3 * self.options.repeats):
            runs.draw_all()
            self.result["knobs"] = runs.rows()

    def _time_avx512(self, subjects: list[Subject]) -> None:
        if reason := why_not():
            self.result["no_avx512"] = reason
            return
        with Comparison(subjects) as comparison:
            for turn in self._turns("AVX-512", self.options.repeats):
                comparison.draw_all(turn)
                self.result["avx512"] = comparison.rows()

    def _time_others(self, pythons: dict[str, Path]) -> None:
        self.result["others"] = []
        for count in OTHERS_COUNTS:
            records, camera = records_of(object_scene(count, self.options.seed)), square_camera()
            gaussians = gaussians_of(records)
            with contextlib.ExitStack() as stack:
                file = Path(stack.enter_context(tempfile.TemporaryDirectory()), "scene.splat")
                records.tofile(file)
                drawers = [stack.enter_context(Drawer(name, p, file, camera)) for name, p in pythons.items()]
                times = Times()
                for turn in self._turns(f"others, {count:,}", self.options.other_repeats):
                    times = times if turn > 1 else Times()
                    for _ in range(3):  # ours are short: a sample as good as the others' needs more
                        times.time("msdgs", rasterize, gaussians, camera)
                    for drawer in drawers:
                        times.add(drawer.name, drawer.draw())
                images = {drawer.name: drawer.image() for drawer in drawers}
                versions = {drawer.name: drawer.version for drawer in drawers}
            milliseconds = times.milliseconds()
            rows = [{"name": "msdgs", "count": count, "milliseconds": milliseconds["msdgs"], "times_ours": 1.0}]
            for name, picture in images.items():
                ours = rasterize(gaussians, camera, options=AS_DRAWN_BY[name]).rgb
                times_ours = milliseconds[name]["min"] / milliseconds["msdgs"]["min"]
                rows.append({"name": f"{name} {versions[name]}", "count": count, "milliseconds": milliseconds[name]})
                rows[-1] |= {"times_ours": times_ours, "psnr": psnr(ours, picture)}
            self.result["others"] += rows

    def _time_checkouts(self, other: Path) -> None:
        here = Path(__file__).resolve().parents[1]
        self.result["checkouts"] = []
        for count in self.options.counts:
            scene, camera = object_scene(count, self.options.seed), square_camera()
            with contextlib.ExitStack() as stack:
                file = Path(stack.enter_context(tempfile.TemporaryDirectory()), "scene.npz")
                np.savez(file, **vars(scene))
                checkouts = {"this one": here, "the other": other.resolve()}
                drawers = [
                    stack.enter_context(Drawer(name, sys.executable, file, camera, checkout))
                    for name, checkout in checkouts.items()
                ]
                times = Times()
                for turn in self._turns(f"checkouts, {count:,}", self.options.repeats):
                    for drawer in drawers if turn % 2 else drawers[::-1]:
                        times.add(drawer.name, drawer.draw())
                images = [drawer.image() for drawer in drawers]
            milliseconds = times.milliseconds()
            ratio = milliseconds["the other"]["min"] / milliseconds["this one"]["min"]
            error = psnr(*images)
            row = {"count": count, "milliseconds": milliseconds, "ratio": ratio}
            row["psnr"] = error if np.isfinite(error) else None
            self.result["checkouts"].append(row)


def predict(rows: list[dict[str, Any]], seeded: list[dict[str, Any]]) -> None:
    """Add to real scenes the milliseconds that seeded ones would take with as much work: a fit to these with costs of
    0 or more for a Gaussian, a tile entry, a lane and a pixel."""

    def work(row: dict[str, Any]) -> list[float]:
        return [row["count"], row["tile_entries"], row["lanes"], row["size"][0] * row["size"][1]]

    took = np.array([row["milliseconds"]["total"]["min"] for row in seeded])
    costs, _ = nnls(np.array([work(row) for row in seeded]) / took[:, None], np.ones(len(took)))
    for row in rows:
        row["predicted_milliseconds"] = float(np.dot(costs, work(row)))


def square_camera() -> Camera:
    width, height = map(int, SQUARE.split("x"))
    return object_camera(width, height)


def cpu_name() -> str:
    """Of Linux, or what Python knows."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def main(options: Benchmark) -> int:
    """Measure, print, write."""
    console = Console(highlight=False)
    if not console.is_terminal:
        console = Console(highlight=False, width=170)
    with Progress(console=Console(stderr=True), transient=True) as progress:
        run, stopped = Run(options, progress), False
        try:
            run.measure()
        except KeyboardInterrupt:
            stopped = True
    print_tables(run.result, console)
    if options.json:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        write_text(options.json, json.dumps(run.result, indent=1) + "\n")
    if options.plot and "frames" in run.result:
        draw_plot(run.result, options.plot)
    if stopped:
        console.print("stopped: not all was measured")
    return 130 if stopped else 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Benchmark)))

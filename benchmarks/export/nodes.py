"""Size, error and time of exported models on control nodes, random and of the paper's size."""

import math
import os
import sys
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import tyro
from rich.console import Console
from rich.progress import track

from benchmarks.export.paper_sized import resized
from benchmarks.measuring import Times, machine, report_console, table
from msdgs_export.jobs.builder import CandidateBuilder
from msdgs_export.jobs.candidate import Measured
from msdgs_export.jobs.checkpoint import Checkpoint
from msdgs_export.jobs.packing import stored
from msdgs_export.jobs.ruler import Ruler
from msdgs_export.jobs.verify import TIMES, verify
from msdgs_export.jobs.write import properties
from msdgs_export.measure.poses import posed
from msdgs_export.plans.base import BASELINE
from msdgs_export.plans.registry import build
from msdgs_export.pruning.mask import PruningMask, full_mask, pruned
from msdgs_export.storage.choice import GROUPS, packed
from msdgs_export.target import Target
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.scene.baked import MOVING_OUTPUTS
from msdgs_serve.threads import THREADS_VARIABLE
from msdgs_train.gaussians.model_file import save_model
from msdgs_train.supports.nodes import NodesConfig
from msdgs_train.systems.small import SMALL_LAYER
from tests.support.models import SCENE, random_model

OPENINGS = 3


@dataclass(frozen=True)
class Nodes:
    """Export random models on control nodes as `msdgs-export --plan network` does, unpruned, in float32 and in
    fewer bits, and print errors, sizes and times.

    python -m benchmarks.export.nodes --widths 96 128 --seeds 0 1

    Errors are the largest at 50 times against the checkpoint in float64, as docs/contract.md defines `measured_error`,
    and of the worst of 48 frames; motion is the largest between the first and the last time, in scene units. Times are
    of `DeformationSession.pose` of all Gaussians.
    """

    count: int = 106_500
    """Gaussians, all of which move."""
    layers: int = 10
    """MLP layers, two hidden ones each."""
    widths: tuple[int, ...] = (96, 128)
    """Width of the hidden layers; a model each."""
    nodes: int = 512
    """Control nodes."""
    followed: int = 4
    """Nodes that each Gaussian follows."""
    seeds: tuple[int, ...] = (0, 1)
    """A model each."""
    noise: float = 0.05
    """Standard deviation of the noise added to all parameters but means."""
    threads: tuple[int, ...] = (1, 2)
    """Threads of onnxruntime."""
    repeats: int = 100
    """Poses that are timed, at other times each."""
    size: int = 256
    """Width of the frames in pixels."""
    check: bool = False
    """Test this benchmark on a model of 2,000 Gaussians."""


def main(settings: Nodes) -> int:
    """Measure each model and print the tables."""
    if settings.check:
        return self_test()
    models = [(width, seed) for width in settings.widths for seed in settings.seeds]
    rows = [measured(settings, *model) for model in track(models, "models", console=Console(stderr=True))]
    console, names = report_console(), MOVING_OUTPUTS
    title = f"{settings.count:,} Gaussians, {settings.layers} layers, {settings.nodes} nodes"
    errors = table(title, "width, seed", "motion", *names, "worst frame, dB")
    files = table(
        "files", "width, seed", "storage", "MB", "bytes per Gaussian, static", "moving", "worst frame, dB", "opening, s"
    )
    columns = [f"{n} threads: {w}" for n in settings.threads for w in ("median", "95 %", "CPU")]
    times = table("ms per pose", "width, seed", *columns)
    for row in rows:
        found = [f"{row['errors'][name]:.1e}" for name in names]
        errors.add_row(row["name"], f"{row['motion']:.2f}", *found, f"{row['psnr_worst']:.1f}")
        for storage, file in row["files"].items():
            numbers = file["bytes"] / 1e6, file["static"], file["static"] + file["moving"], file["psnr_worst"]
            files.add_row(row["name"], storage, *(f"{n:.1f}" for n in numbers), f"{file['opening']:.2f}")
        times.add_row(row["name"], *(f"{value:.1f}" for each in row["times"].values() for value in each))
    for each in (machine(), errors, files, times):
        console.print(each)
    return 0


def measured(settings: Nodes, width: int, seed: int) -> dict[str, Any]:
    """The figures of one model."""
    support = NodesConfig(num_nodes=settings.nodes, k_nearest=settings.followed)
    chain = (replace(SMALL_LAYER, width=width),) * settings.layers
    model = random_model(
        settings.count, seed, settings.noise, layers=chain, support=support, embedding_dim=0, sh_degree=0
    )
    with tempfile.TemporaryDirectory() as folder:
        checkpoint = Path(folder) / "model.pt"
        save_model(checkpoint, model, replace(SCENE, cameras=[resized(c, settings.size) for c in SCENE.cameras]), 1)
        loaded, target = Checkpoint.load(checkpoint), Target()
        ruler = Ruler(loaded)
        builder = CandidateBuilder.of(loaded, ruler, target, Path(folder), rules=())
        whole = ruler.measured(builder.candidate(BASELINE, None))
        smaller, candidate = stored(whole, ruler, target.min_psnr), whole.candidate
        kinds = properties(onnx.load(smaller.candidate.path))["left_out"][-1]["stored"]
        return {
            "name": f"{width}, {seed}",
            "errors": verify(candidate.session, candidate.pruned.moving, times=TIMES, tolerance=math.inf),
            "motion": float(np.abs(np.subtract(*(candidate.session.pose(t)[0] for t in loaded.info.time_range))).max()),
            "psnr_worst": whole.error.psnr_worst,
            "files": {
                "float32": _file(loaded, whole, {}),
                ", ".join(f"{name} {kind}" for name, kind in kinds.items()): _file(loaded, smaller, kinds),
            },
            "times": milliseconds(smaller.candidate.path, settings),
        }


def _file(checkpoint: Checkpoint, measured: Measured, kinds: Mapping[str, str]) -> dict[str, float]:
    candidate, error = measured
    static, moving = bytes_per_gaussian(checkpoint, candidate.size, kinds)
    figures = {"bytes": candidate.size, "static": static, "moving": moving}
    return {**figures, "psnr_worst": error.psnr_worst, "opening": _seconds_to_open(candidate.path)}


def bytes_per_gaussian(checkpoint: Checkpoint, size: int, kinds: Mapping[str, str]) -> tuple[float, float]:
    """Bytes of a static Gaussian, and how many more a moving one takes. `size` is that of the file in which all move;
    it is compared with files in which every second Gaussian is static or left out, whose arrays are stored alike."""
    whole, count = full_mask(checkpoint.model), len(checkpoint.model.gaussians)
    canonical, first = posed(checkpoint.model, 0.0, deform=False), np.arange(count) % 2 == 0
    alike = {**kinds, **{f"static {name}": kind for name, kind in kinds.items() if f"static {name}" in GROUPS}}

    def size_of(mask: PruningMask) -> int:
        baked = checkpoint.bake(pruned(checkpoint.model, mask, canonical, []))
        return packed(build(BASELINE, baked), alike).ByteSize()

    half_static, half = size_of(whole.without(moves=first)), size_of(whole.without(kept=first))
    changed = count - int(first.sum())
    return (half_static - half) / changed, (size - half_static) / changed


def milliseconds(path: Path, settings: Nodes) -> dict[int, tuple[float, float, float]]:
    """Median and 95 % quantile of the time of a pose, and median of its processor time, by number of threads."""
    sessions = {threads: _opened(path, threads) for threads in settings.threads}
    wall, processor = Times(), Times(time.process_time)
    for t in np.linspace(0, 1, settings.repeats):
        for threads, session in sessions.items():
            processor.time(str(threads), wall.time, str(threads), session.pose, float(t))
    found = {}
    for threads in settings.threads:
        of_pose, of_processor = (1e3 * np.array(each.seconds[str(threads)]) for each in (wall, processor))
        found[threads] = (float(np.median(of_pose)), float(np.quantile(of_pose, 0.95)), float(np.median(of_processor)))
    return found


def _opened(path: Path, threads: int) -> DeformationSession:
    """A session with this number of threads."""
    before = os.environ.get(THREADS_VARIABLE)
    os.environ[THREADS_VARIABLE] = str(threads)
    try:
        return DeformationSession(path)
    finally:
        del os.environ[THREADS_VARIABLE]
        if before is not None:
            os.environ[THREADS_VARIABLE] = before


def _seconds_to_open(path: Path) -> float:
    times = Times()
    for _ in range(OPENINGS):
        times.time("open", DeformationSession, path)
    return times.minimum("open") / 1e3


def self_test() -> int:
    """The export of a small model is exact, and each Gaussian adds the expected number of bytes to its file."""
    found = measured(Nodes(count=2_000, layers=2, nodes=20, repeats=3, size=48), 32, 0)
    assert max(found["errors"][name] for name in MOVING_OUTPUTS) < 1e-4
    assert found["psnr_worst"] > 60
    assert found["motion"] > 0.01
    exact, small = found["files"].values()
    static = 4 * (3 + 4 + 3 + 1 + 3)  # mean, quaternion, scale, opacity, color
    assert abs(exact["static"] - static) < 1
    assert small["static"] < static / 2
    assert 0 < small["moving"] <= 12
    assert small["psnr_worst"] >= Target().min_psnr
    return main(Nodes(count=200, layers=1, widths=(16,), nodes=8, seeds=(0,), repeats=2, size=32))


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Nodes)))

"""Times of whole training steps at three points of a run, and how long the whole run would take."""

import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import torch
import tyro

from benchmarks.measuring import machine, report_console, table
from msdgs_train.datasets import SceneData, load_scene
from msdgs_train.datasets.synthetic.generate import generate
from msdgs_train.engine.config import TrainConfig
from msdgs_train.engine.trainer import Trainer
from msdgs_train.layers.precision import Precision
from msdgs_train.rendering.rasterize import require_device
from msdgs_train.systems.registry import preset

POINTS = (1 / 6, 1 / 2, 5 / 6)
"""Fractions of the run at which steps are timed; each stands for a third of it."""
WARM_UP = 20
"""Steps before those that are timed."""


@dataclass(frozen=True)
class Options:
    """Time steps in the middle of each third of a run, and project the run's length. Gaussians are random, as many as
    `gaussians` says: give the numbers of a real run.

    python -m benchmarks.training.gpu_step data/lego --preset msdgs-mlp --device cuda --precision tf32
    """

    data: Annotated[Path | None, tyro.conf.Positional] = None
    """A dataset folder; by default a synthetic scene is generated."""
    preset: str = "msdgs-mlp"
    """The system that is trained."""
    device: Literal["cpu", "cuda"] = "cuda"
    precision: Precision = "float32"
    """Of MLP trunks on a GPU."""
    size: int = 800
    """Width of the images in pixels."""
    gaussians: tuple[int, int, int] = (100_000, 150_000, 150_000)
    """Numbers of Gaussians at the three points."""
    run_steps: int = 40_000
    """Length of the run that is projected."""
    steps: int = 1_000
    """Steps that are timed at each point."""
    check: bool = False
    """Test this benchmark on the CPU at a small size."""


def main(options: Options) -> int:
    """Measure and print."""
    if options.check:
        options = replace(options, preset="msdgs-small", device="cpu", size=32, gaussians=(200, 300, 300))
        options = replace(options, run_steps=60, steps=3)
    require_device(options.device)
    with tempfile.TemporaryDirectory() as made:
        data = options.data
        if data is None:
            data = Path(made) / "scene"
            generate(data, size=options.size, train_frames=8, test_frames=2)
        scene = load_scene(data, options.size).normalized()
        found = [measure(options, scene, *point) for point in zip(POINTS, options.gaussians, strict=True)]
    show(options, found)
    return 0


def measure(options: Options, scene: SceneData, fraction: float, count: int) -> float:
    """Seconds of a step, the mean over `options.steps`, after this fraction of the run with so many Gaussians."""
    trainer = trainer_at(configuration(options, count), scene, round(fraction * options.run_steps))
    assert trainer.schedule.deforms(trainer.step_count) or not trainer.config.model.layers
    for _ in range(min(WARM_UP, options.steps)):
        trainer.step()
    wait(options.device)
    start = time.perf_counter()
    for _ in range(options.steps):
        trainer.step()
    wait(options.device)
    assert trainer.system.size == count
    return (time.perf_counter() - start) / options.steps


def configuration(options: Options, count: int) -> TrainConfig:
    """The preset with a constant number of Gaussians: rounds of density control are timed with nothing to do."""
    return preset(options.preset).updated(
        steps=options.run_steps,
        device=options.device,
        gpu_precision=options.precision,
        init_num_pts=count,
        max_gaussians=count,
        prune_opa=0.0,
        prune_unseen_passes=0.0,
        reset_every_fraction=0.0,
    )


def trainer_at(config: TrainConfig, scene: SceneData, step: int) -> Trainer:
    """A new trainer whose schedule is at this step."""
    trainer = Trainer(config, scene)
    trainer.step_count, trainer.reached = step, range(step + 1)  # as if all steps up to this one were one
    return trainer


def wait(device: str) -> None:
    """Until the device has done its work."""
    if device == "cuda":
        torch.cuda.synchronize()


def show(options: Options, seconds: list[float]) -> None:
    """Print the table and the projection."""
    on_gpu = options.device == "cuda"
    made = table(
        f"{options.preset}, {options.size} pixels wide, {options.precision}, {options.steps:,} steps at each point",
        *("of the run", "Gaussians", "ms a step"),
    )
    for fraction, count, each in zip(POINTS, options.gaussians, seconds, strict=True):
        made.add_row(f"{fraction:.0%}", f"{count:,}", f"{1e3 * each:.2f}")
    minutes = options.run_steps * sum(seconds) / len(seconds) / 60
    memory = f", {torch.cuda.max_memory_allocated() / 2**30:.1f} GiB at most" if on_gpu else ""
    report_console().print(
        machine() + (f", {torch.cuda.get_device_name()}" if on_gpu else ""),
        made,
        f"{options.run_steps:,} steps: {minutes:.1f} minutes, without evaluations{memory}",
        sep="\n",
    )


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Options)))

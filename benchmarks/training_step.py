"""Where the time of a training step goes: deformation, projection, tiles, blending, loss, each with its gradient, and
the optimiser.

python benchmarks/training_step.py --gaussians 10000 --size 200
python benchmarks/training_step.py data/scene --preset msdgs-mlp --gaussians 30000 --size 400

Without a folder it trains on a synthetic scene that it makes. The parts are measured one after the other on the same
step, repeat after repeat; least and median of the repeats are printed, and what the parts add up to beside whole steps.
In turns with them, steps of several images side by side.
"""

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from msdgs_serve.rasterizer.compositing import composite
from msdgs_serve.rasterizer.compositing_backward import composite_backward
from msdgs_serve.rasterizer.projection import project
from msdgs_serve.rasterizer.projection_backward import project_backward
from msdgs_serve.rasterizer.tiles import bin_into_tiles
from msdgs_serve.rasterizer.view import GSPLAT
from msdgs_serve.scene import Gaussians
from msdgs_train.datasets import load_scene
from msdgs_train.datasets.synthetic.generate import generate
from msdgs_train.engine.trainer import Trainer
from msdgs_train.losses.photometric import photometric_loss
from msdgs_train.systems.presets import preset

FORWARD = ("deformation", "projection", "tiles", "blending", "loss")
BACKWARD = ("loss gradient", "blending gradient", "projection gradient", "deformation gradient", "optimiser")


def main() -> None:
    """Measure and print."""
    arguments = parse_arguments()
    with tempfile.TemporaryDirectory() as made:
        several, trainer = (make_trainer(arguments, Path(made), n) for n in (arguments.batch_size, 1))
        for _ in range(3):  # compiled, and Adam has its moments
            trainer.step()
            several.step()
        repeats = [dict(measured(trainer, several)) for _ in range(arguments.repeats)]
    show(repeats, arguments)


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, nargs="?", help="a folder of images; default: a synthetic scene")
    parser.add_argument("--preset", default="msdgs-small", help="whose networks are trained")
    parser.add_argument("--gaussians", type=int, default=10_000)
    parser.add_argument("--size", type=int, default=200, help="width of the images in pixels")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--batch-size", type=int, default=4, help="side by side, to compare with one after the other")
    parser.add_argument("--repeats", type=int, default=15)
    return parser.parse_args()


def make_trainer(arguments: argparse.Namespace, made: Path, batch_size: int) -> Trainer:
    """A trainer at a step at which all of the model takes part."""
    data = arguments.data
    if data is None:
        data = made / "scene"
        if not data.exists():
            generate(data, size=arguments.size, train_frames=8, test_frames=2)
    count = arguments.gaussians
    config = replace(
        preset(arguments.preset),
        init_num_pts=count,
        max_gaussians=count,
        batch_size=batch_size,
        threads=arguments.threads,
        static_fraction=0.0,
        refine_stop_fraction=0.0,
    )
    return Trainer(config, load_scene(data, arguments.size))


def measured(trainer: Trainer, several: Trainer) -> Iterator[tuple[str, float]]:
    """Seconds by part of a step of one image, then of a whole one, and of one of several."""
    torch.set_num_threads(trainer.config.threads)
    model, frame = trainer.model, trainer.frames[0]
    background = torch.zeros(3)
    target = trainer._image(frame, background)

    def timed(function: Callable[[], Any]) -> tuple[Any, float]:
        start = time.perf_counter()
        return function(), time.perf_counter() - start

    camera = frame.camera
    posed, seconds = timed(lambda: model.pose(frame.t))
    yield "deformation", seconds
    gaussians = Gaussians(*(tensor.detach().contiguous().numpy() for tensor in posed))
    splats, seconds = timed(lambda: project(gaussians, camera, GSPLAT))
    yield "projection", seconds
    tiles, seconds = timed(lambda: bin_into_tiles(splats, camera.width, camera.height))
    yield "tiles", seconds
    drawn, seconds = timed(
        lambda: composite(splats, tiles, camera.width, camera.height, np.zeros(3, np.float32), GSPLAT)
    )
    yield "blending", seconds
    rgb = torch.from_numpy(drawn.rgb).requires_grad_()
    loss, seconds = timed(lambda: photometric_loss(rgb, target, trainer.config.l1_weight))
    yield "loss", seconds
    _, seconds = timed(loss.backward)
    yield "loss gradient", seconds
    assert rgb.grad is not None
    grad_rgb = rgb.grad.numpy()
    sums, seconds = timed(
        lambda: composite_backward(splats, tiles, GSPLAT, drawn, grad_rgb, np.zeros(grad_rgb.shape[:2], np.float32))
    )
    yield "blending gradient", seconds
    grads, seconds = timed(lambda: project_backward(gaussians, splats, sums, camera, GSPLAT))
    yield "projection gradient", seconds
    tensors = [torch.from_numpy(np.ascontiguousarray(array)) for array in grads[:5]]
    trainer.optimizer.zero_grad(set_to_none=True)
    _, seconds = timed(lambda: torch.autograd.backward(list(posed), tensors))
    yield "deformation gradient", seconds
    _, seconds = timed(trainer.optimizer.step)
    yield "optimiser", seconds
    _, seconds = timed(trainer.step)
    yield "whole step", seconds
    torch.set_num_threads(1)
    _, seconds = timed(several.step)
    yield "several", seconds


def show(repeats: list[dict[str, float]], arguments: argparse.Namespace) -> None:
    """The table, and the two ratios that matter."""
    least = {name: min(repeat[name] for repeat in repeats) * 1e3 for name in repeats[0]}
    median = {name: float(np.median([repeat[name] for repeat in repeats])) * 1e3 for name in repeats[0]}
    parts = sum(least[name] for name in (*FORWARD, *BACKWARD))
    table = Table("part", "ms, least", "ms, median", "share", box=None)
    for name in (*FORWARD, *BACKWARD):
        table.add_row(name, f"{least[name]:.1f}", f"{median[name]:.1f}", f"{least[name] / parts:.0%}")
    table.add_row("all of these", f"{parts:.1f}", f"{sum(median[name] for name in (*FORWARD, *BACKWARD)):.1f}", "")
    table.add_row("a whole step", f"{least['whole step']:.1f}", f"{median['whole step']:.1f}", "")
    console = Console()
    console.print(
        f"{arguments.preset}, {arguments.gaussians:,} Gaussians, {arguments.size} pixels wide, "
        f"{arguments.threads} threads, {arguments.repeats} repeats"
    )
    console.print(table)
    render = least["projection"] + least["tiles"] + least["blending"]
    gradient = least["blending gradient"] + least["projection gradient"]
    console.print(f"rasterizer: gradient / forward = {gradient / render:.2f}")
    step = least["whole step"] / (render + least["deformation"])
    console.print(f"whole step / (forward rendering + deformation) = {step:.2f}")
    each = least["several"] / arguments.batch_size
    console.print(
        f"{arguments.batch_size} images side by side: {each:.1f} ms each, "
        f"{least['whole step'] / each:.2f} times as many a second"
    )


if __name__ == "__main__":
    main()

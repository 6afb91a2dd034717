"""Where the time of a training step goes: deformation, projection, tiles, blending, loss, each with its gradient, and
the optimizer.

python -m benchmarks.training.training_step --gaussians 10000 --size 200
python -m benchmarks.training.training_step data/scene --preset msdgs-mlp --gaussians 30000 --size 400

Without a folder it trains on a synthetic scene that it makes. The parts are measured one after the other on the same
step, repeat after repeat; minimum and median of the repeats are printed, and the sum of the parts beside whole steps.
In turns with them, steps of several images side by side.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from benchmarks.measuring import Times, machine
from msdgs_serve.rasterizer.compositing import composite
from msdgs_serve.rasterizer.compositing_backward import composite_backward
from msdgs_serve.rasterizer.projection import project
from msdgs_serve.rasterizer.projection_backward import project_backward
from msdgs_serve.rasterizer.tiles import bin_into_tiles
from msdgs_serve.rasterizer.view import GSPLAT
from msdgs_serve.scene import Gaussians
from msdgs_train.datasets import load_scene
from msdgs_train.datasets.cache import ImageCache
from msdgs_train.datasets.synthetic.generate import generate
from msdgs_train.engine.trainer import Trainer
from msdgs_train.losses.photometric import photometric_loss
from msdgs_train.systems.gaussian_splatting import GaussianSplatting
from msdgs_train.systems.registry import preset

FORWARD = ("deformation", "projection", "tiles", "blending", "loss")
BACKWARD = ("loss gradient", "blending gradient", "projection gradient", "deformation gradient", "optimizer")


def main() -> None:
    """Measure and print."""
    arguments = parse_arguments()
    with tempfile.TemporaryDirectory() as made:
        several, trainer = (make_trainer(arguments, Path(made), n) for n in (arguments.images, 1))
        for _ in range(3):  # compiled, and Adam has its moments
            trainer.step()
            several.step()
        times = Times()
        for _ in range(arguments.repeats):
            measure(trainer, several, times)
    show(times, arguments)


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, nargs="?", help="a dataset folder; default: a synthetic scene")
    parser.add_argument("--preset", default="msdgs-small", help="whose networks are trained")
    parser.add_argument("--gaussians", type=int, default=10_000)
    parser.add_argument("--size", type=int, default=200, help="width of the images in pixels")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--images", type=int, default=4, help="side by side, to compare with one after the other")
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--check", action="store_true", help="only see that this works, at a small size")
    arguments = parser.parse_args()
    if arguments.check:
        arguments.gaussians, arguments.size, arguments.repeats, arguments.threads = 300, 32, 2, 1
    return arguments


def make_trainer(arguments: argparse.Namespace, made: Path, images: int) -> Trainer:
    """A trainer at a step at which all of the model takes part."""
    data = arguments.data
    if data is None:
        data = made / "scene"
        if not data.exists():
            generate(data, size=arguments.size, train_frames=8, test_frames=2)
    count = arguments.gaussians
    config = preset(arguments.preset).updated(
        init_num_pts=count,
        max_gaussians=count,
        batch_size=images,
        threads=arguments.threads,
        static_fraction=0.0,
        refine_stop_fraction=0.0,
    )
    return Trainer(config, load_scene(data, arguments.size))


def measure(trainer: Trainer, several: Trainer, times: Times) -> None:
    """The parts of a step of one image, then a whole one, and one of several images."""
    torch.set_num_threads(trainer.config.run.threads)
    system = trainer.system
    assert isinstance(system, GaussianSplatting)
    frame = trainer.scene.splits["train"][0]
    camera, zeros = frame.camera, np.zeros((frame.camera.height, frame.camera.width), np.float32)
    size, black = (camera.width, camera.height), np.zeros(3, np.float32)
    target = ImageCache().image(frame, torch.zeros(3))
    posed = times.time("deformation", system.model.pose, frame.t)
    gaussians = Gaussians(*(tensor.detach().contiguous().numpy() for tensor in posed))
    splats = times.time("projection", project, gaussians, camera, GSPLAT)
    tiles = times.time("tiles", bin_into_tiles, splats, *size)
    drawn = times.time("blending", composite, splats, tiles, *size, black, GSPLAT)
    rgb = torch.from_numpy(drawn.rgb).requires_grad_()
    loss = times.time("loss", photometric_loss, rgb, target, 1 - trainer.config.loss.ssim_lambda)
    times.time("loss gradient", loss.backward)
    assert rgb.grad is not None
    sums = times.time("blending gradient", composite_backward, splats, tiles, GSPLAT, drawn, rgb.grad.numpy(), zeros)
    grads = times.time("projection gradient", project_backward, gaussians, splats, sums, camera, GSPLAT)
    tensors = [torch.from_numpy(np.ascontiguousarray(array)) for array in grads[:5]]
    trainer.optimizer.zero_grad(set_to_none=True)
    times.time("deformation gradient", torch.autograd.backward, list(posed), tensors)
    times.time("optimizer", trainer.optimizer.step)
    times.time("whole step", trainer.step)
    torch.set_num_threads(1)
    times.time("several", several.step)


def show(times: Times, arguments: argparse.Namespace) -> None:
    """The table, and the ratios that matter."""
    found = times.milliseconds()
    least = {name: each["min"] for name, each in found.items()}
    total = {kind: sum(found[name][kind] for name in (*FORWARD, *BACKWARD)) for kind in ("min", "median")}
    table = Table("part", "ms, minimum", "ms, median", "share", box=None)
    for name in (*FORWARD, *BACKWARD):
        table.add_row(name, f"{least[name]:.1f}", f"{found[name]['median']:.1f}", f"{least[name] / total['min']:.0%}")
    table.add_row("all of these", f"{total['min']:.1f}", f"{total['median']:.1f}", "")
    table.add_row("a whole step", f"{least['whole step']:.1f}", f"{found['whole step']['median']:.1f}", "")
    console = Console(soft_wrap=True)
    console.print(machine())
    console.print(
        f"{arguments.preset}, {arguments.gaussians:,} Gaussians, {arguments.size} pixels wide, "
        f"{arguments.threads} threads, {arguments.repeats} repeats"
    )
    console.print(table)
    forward = least["projection"] + least["tiles"] + least["blending"]
    gradient = least["blending gradient"] + least["projection gradient"]
    each, step = least["several"] / arguments.images, least["whole step"]
    console.print(f"rasterizer: gradient / forward = {gradient / forward:.2f}")
    console.print(f"whole step / (forward rendering + deformation) = {step / (forward + least['deformation']):.2f}")
    console.print(
        f"{arguments.images} images side by side: {each:.1f} ms each, {step / each:.2f} times as many a second"
    )


if __name__ == "__main__":
    main()

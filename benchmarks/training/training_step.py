"""The time of a training step by part: deformation, projection, tiles, blending, loss, their gradients, optimizer."""

import os
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import tyro

from benchmarks.measuring import Times, machine, minimum_and_median, report_console, table
from msdgs_serve.rasterizer.compositing import composite
from msdgs_serve.rasterizer.compositing_backward import composite_backward
from msdgs_serve.rasterizer.projection import project
from msdgs_serve.rasterizer.projection_backward import project_backward
from msdgs_serve.rasterizer.tiles import bin_into_tiles
from msdgs_serve.rasterizer.view import GSPLAT
from msdgs_serve.scene import Gaussians
from msdgs_serve.threads import THREADS_VARIABLE
from msdgs_train.datasets import load_scene
from msdgs_train.datasets.cache import ImageCache
from msdgs_train.datasets.synthetic.generate import generate
from msdgs_train.engine.trainer import Trainer
from msdgs_train.layers.arrays import to_array
from msdgs_train.losses.photometric import photometric_loss
from msdgs_train.systems.gaussian_splatting import GaussianSplatting
from msdgs_train.systems.registry import preset

PARTS = ("deformation", "projection", "tiles", "blending", "loss", "loss gradient", "blending gradient",
         "projection gradient", "deformation gradient", "optimizer")  # fmt: skip

ON_GPU = "whole step on the GPU"


@dataclass(frozen=True)
class Options:
    """Measure the parts of a training step one after the other, repeat after repeat, and whole steps of one and of
    several images in turns with them.

    python -m benchmarks.training.training_step --gaussians 10000 --size 200

    python -m benchmarks.training.training_step data/scene --preset msdgs-mlp --gaussians 30000 --size 400
    """

    data: Annotated[Path | None, tyro.conf.Positional] = None
    """A dataset folder; by default a synthetic scene is generated."""
    preset: str = "msdgs-small"
    """The preset whose networks are trained."""
    gaussians: int = 10_000
    size: int = 200
    """Width of the images in pixels."""
    threads: int = torch.get_num_threads()
    images: int = 4
    """Images of a step that is compared with a step of one image."""
    gpu: bool = False
    """Also time whole steps on the GPU, with gsplat."""
    repeats: int = 15
    check: bool = False
    """Test this benchmark at a small size."""


def main(options: Options) -> int:
    """Measure and print."""
    if options.check:
        options = replace(options, check=False, gaussians=300, size=32, repeats=2, threads=1)
    os.environ[THREADS_VARIABLE] = str(options.threads)
    with tempfile.TemporaryDirectory() as made:
        several, trainer = (make_trainer(options, Path(made), n) for n in (options.images, 1))
        on_gpu = make_trainer(options, Path(made), 1, "cuda") if options.gpu else None
        for _ in range(3):  # compiles kernels and gives Adam its moments
            trainer.step()
            several.step()
            if on_gpu:
                step_on_gpu(on_gpu)
        times = Times()
        for _ in range(options.repeats):
            measure(trainer, several, times)
            if on_gpu:
                times.time(ON_GPU, step_on_gpu, on_gpu)
    show(times, options)
    return 0


def make_trainer(options: Options, made: Path, images: int, device: str = "cpu") -> Trainer:
    """A trainer whose steps train the whole model."""
    data = options.data
    if data is None:
        data = made / "scene"
        if not data.exists():
            generate(data, size=options.size, train_frames=8, test_frames=2)
    count = options.gaussians
    config = preset(options.preset).updated(
        init_num_pts=count,
        max_gaussians=count,
        batch_size=images,
        threads=options.threads,
        device=device,
        static_fraction=0.0,
        static_window_fraction=0.0,
        sh_degree_fraction=0.0,
        half_resolution_fraction=0.0,
        refine_stop_fraction=0.0,
    )
    trainer = Trainer(config, load_scene(data, options.size).normalized())
    assert trainer.schedule.deforms(0) or not config.model.layers
    assert trainer.schedule.sh_degree(0) == config.model.sh_degree
    return trainer


def step_on_gpu(trainer: Trainer) -> None:
    """A step, until the GPU has ended it."""
    trainer.step()
    torch.cuda.synchronize()


def measure(trainer: Trainer, several: Trainer, times: Times) -> None:
    """Time the parts of a step of one image, then a whole step, and a step of several images."""
    torch.set_num_threads(trainer.config.run.threads)
    system = trainer.system
    assert isinstance(system, GaussianSplatting)
    frame = trainer.scene.splits["train"][0]
    camera, zeros = frame.camera, np.zeros((frame.camera.height, frame.camera.width), np.float32)
    size, black = (camera.width, camera.height), np.zeros(3, np.float32)
    target = ImageCache().image(frame, torch.zeros(3))
    posed = times.time("deformation", system.model.pose, frame.t)
    gaussians = Gaussians(*map(to_array, posed))
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


def show(times: Times, options: Options) -> None:
    """Print the table, and the ratios that matter."""
    found = times.milliseconds()
    least = {name: each["min"] for name, each in found.items()}
    found["all parts"] = {kind: sum(found[name][kind] for name in PARTS) for kind in ("min", "median")}
    made = table(
        f"{options.preset}, {options.gaussians:,} Gaussians, {options.size} pixels wide, {options.threads} threads, "
        f"{options.repeats} repeats",
        *("part", "ms, minimum (median)", "share"),
    )
    for name in (*PARTS, "all parts", "whole step", *([ON_GPU] if options.gpu else [])):
        share = f"{least[name] / found['all parts']['min']:.0%}" if name in PARTS else ""
        made.add_row(name, minimum_and_median(found[name]), share)
    forward = least["projection"] + least["tiles"] + least["blending"]
    gradient = least["blending gradient"] + least["projection gradient"]
    each, step = least["several"] / options.images, least["whole step"]
    report_console().print(
        machine() + (f", {torch.cuda.get_device_name()}" if options.gpu else ""),
        made,
        f"rasterizer: gradient / forward = {gradient / forward:.2f}",
        f"whole step / (forward rendering + deformation) = {step / (forward + least['deformation']):.2f}",
        f"{options.images} images in one step: {each:.1f} ms each, {step / each:.2f} times as many per second",
        sep="\n",
    )


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Options)))

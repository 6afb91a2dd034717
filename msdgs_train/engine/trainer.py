"""The training of one model in memory: take a step, evaluate, save and restore a checkpoint."""

import functools
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils import clip_grad_norm_

from msdgs_serve.threads import sharing_cores
from msdgs_train.datasets import Frame, SceneData
from msdgs_train.datasets.cache import ImageCache, bytes_of
from msdgs_train.datasets.common.backdrop import Color
from msdgs_train.datasets.rays import RayBatch, RayBatches
from msdgs_train.engine.config import TrainConfig
from msdgs_train.engine.curriculum import WindowCurriculum
from msdgs_train.engine.gradients import ViewGradients, average_gradients, differentiate
from msdgs_train.engine.meters import DeviceMeter, Observed, StepMeter
from msdgs_train.engine.optimizer import make_optimizer, set_learning_rates
from msdgs_train.engine.schedule import Schedule
from msdgs_train.evaluation.metrics import ImageMetrics, image_metrics, psnr_from_mse
from msdgs_train.gaussians import safe_load
from msdgs_train.layers import arrays
from msdgs_train.layers.arrays import to_device
from msdgs_train.layers.parameters import ParamGroup
from msdgs_train.layers.precision import trunk_precision
from msdgs_train.systems.base import ImageSystem, Moment, RaySystem
from msdgs_train.systems.registry import system_of
from msdgs_train.systems.targets import Target, TrainingImages

FORMAT = "msdgs-checkpoint/3"
READ_EVERY = 20  # steps at most between looks at the results of steps on a GPU
ROLLBACK_LR = 0.5  # factor of the learning rates, each time that training returns to a checkpoint
ROLLBACK_SEED = 1_000_003  # added to the seed of the images' order
RENDERED_PER_STEP = 3.0  # times that its rays are rendered while a step on rays is taken


class StepResult(NamedTuple):
    """Metrics after one step; on a GPU, loss to skipped steps are those of the last step that was read."""

    step: int  # of the schedule, counted from 1
    loss: float  # moving average
    psnr: float  # dB, on training images, of the moving average of squared errors
    gaussians: int
    skipped: int  # steps of the whole run whose loss or gradient was not finite


class EvaluatedFrame(NamedTuple):
    """A held-out frame: its image and its rendering, [H, W, 3] in [0, 1]."""

    frame: Frame
    target: Tensor
    rgb: Tensor
    metrics: ImageMetrics


class Trainer:
    """A system, its optimizer and the order of the images, advanced by `step`."""

    def __init__(self, config: TrainConfig, scene: SceneData) -> None:
        torch.set_num_threads(config.run.threads if config.run.batch_size == 1 else 1)
        self.config, self.scene = config, scene
        self.schedule = Schedule.from_config(config)
        self.rollbacks = 0
        run = config.run
        self._images = ImageCache(run.image_memory * 2**30)
        self._is_on_host = arrays.has_kernels(torch.empty(0, device=run.device))
        resident = 0 if self._is_on_host else run.gpu_image_memory * 2**30
        self._training_images = TrainingImages(self._images, run.device, resident)
        self._reset()
        self._rays = None
        if isinstance(self.system, RaySystem):
            training, size = scene.splits["train"], self.system.rays_per_batch
            self._rays = RayBatches(training, size, config.run.device, self.system.hits)

    @property
    def background(self) -> Color:
        """RGB in [0, 1] behind held-out images."""
        return self.config.data.evaluation_background(self.scene)

    def _reset(self) -> None:
        """The state before the first step."""
        self.step_count = self.optimizer_steps = 0
        self.reached = range(1)  # steps of the schedule since the last optimizer step
        self._meter = StepMeter() if self._is_on_host else DeviceMeter(self.config.run.device)
        self._generator = torch.Generator().manual_seed(self.config.run.seed)
        self._curriculum = WindowCurriculum(self.schedule, self.scene.splits["train"], self.scene.time_range)
        self.system: ImageSystem | RaySystem = system_of(self.schedule, self.scene)
        self.optimizer = make_optimizer(self.system.parameter_groups(), self.schedule)

    def step(self, advance: int = 1) -> StepResult:
        """Render the next batch, take a step along its mean gradient, and control density.

        Args:
            advance: steps of the schedule that this optimizer step stands for.
        """
        self.system.before_step(self.optimizer, self.reached)
        groups = self.system.parameter_groups()
        set_learning_rates(self.optimizer, groups, self.schedule, self.step_count, self.lr_factor)
        views = self._render_and_backward(groups)
        average_gradients(groups, views)
        self.reached = range(self.step_count + 1, self.step_count + advance + 1)
        self.step_count += advance
        self.optimizer_steps += 1
        observed = Observed([view.loss for view in views], [view.squared_error for view in views])
        gradients = [p.grad for g in groups for p in g.params if p.grad is not None]
        is_accepted = self._meter.accept(self.step_count, observed, gradients, self.optimizer)
        if is_accepted:
            clip = self.config.optimizer.gradient_clip
            if clip is not None:
                # an outlier would stay in Adam's second moment, and reduce a network's steps, for a thousand steps
                clip_grad_norm_([p for g in groups if g.is_clipped for p in g.params], clip)
            self.optimizer.step()
        seen = [(view.frame, view.view) for view in views if view.frame and is_accepted]
        self.system.after_step(self.optimizer, self.reached, seen)
        return self._result()

    def rehearse(self, step: int) -> None:
        """Compute the gradients of one training image, or batch of rays, as in this step of the schedule, which becomes
        the present one, without training on them: for timings."""
        self.step_count = step
        frame = self.scene.splits["train"][0] if self._rays is None else self._next(0)
        view = self._differentiate(self.system.parameter_groups(), frame, self._next_background(), number=0)
        float(view.loss)  # waits for a GPU

    def _result(self) -> StepResult:
        meter, every, last = self._meter, self.config.logging.log_every, self.config.run.steps
        if any(step % every == 0 or step == last for step in self.reached) or self.optimizer_steps % READ_EVERY == 0:
            meter.read()
            meter.check(self.step_count)
        loss, error = meter.averages or (float("nan"), float("nan"))
        return StepResult(self.step_count, loss, psnr_from_mse(error), self.system.size, meter.skipped)

    @torch.no_grad()
    def evaluate(self, split: str) -> Iterator[EvaluatedFrame]:
        """Render each frame of a split and compute its metrics."""
        background = torch.tensor(self.background)
        on_device = background.to(self.config.run.device)
        for frame in self.scene.splits[split]:
            target = self._images.image(frame, background)
            rgb = self.system.render(frame.camera, frame.t, on_device, self.step_count).cpu()
            yield EvaluatedFrame(frame, target, rgb, image_metrics(rgb, target, self._images.mask(frame)))

    def save_checkpoint(self, path: Path, seconds: float) -> None:
        """Write the complete state, from which training continues bit by bit; `seconds` of training so far. Atomic."""
        self._meter.read()
        state = {
            "format": FORMAT,
            "step_count": self.step_count,
            "optimizer_steps": self.optimizer_steps,
            "reached": (self.reached.start, self.reached.stop),
            "seconds": seconds,
            "skipped": (self._meter.skipped, self._meter.skipped_in_a_row),
            "rollbacks": self.rollbacks,
            "averages": self._meter.averages,
            "averages_weight": self._meter.weight,
            "generators": [generator.get_state() for generator in self._generators()],
            "curriculum": self._curriculum.order,
            "system": self.system.state(),
            "optimizer": self.optimizer.state_dict(),
        }
        safe_load.save_atomic(path, state)

    def load_checkpoint(self, path: Path) -> float:
        """Continue from a checkpoint of a run with the same settings; returns the seconds trained before.

        Raises `CheckpointInvalid`.
        """
        state: dict[str, Any] = safe_load.load(path)
        if not isinstance(state, dict) or state.get("format") != FORMAT:
            raise safe_load.CheckpointInvalid(path, f"isn't of format {FORMAT}: train again in a new folder")
        try:
            self._restore(state)
            return float(state["seconds"])
        except (ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RuntimeError) as error:
            problem = "isn't a complete checkpoint of these settings and this dataset: train again in a new folder"
            raise safe_load.CheckpointInvalid(path, problem) from error

    def roll_back(self, checkpoint: Path) -> None:
        """Return to a checkpoint, or to the start if there is no such file, after training has diverged: with half the
        learning rates and another order of the images."""
        skipped, rollbacks = self._meter.skipped, self.rollbacks + 1
        self._reset()
        if checkpoint.exists():
            self.load_checkpoint(checkpoint)
        self.rollbacks = rollbacks
        self._meter.load(skipped, 0, self._meter.averages, self._meter.weight)
        self._generator.manual_seed(self.config.run.seed + ROLLBACK_SEED * rollbacks)
        self._curriculum.order = torch.empty(0, dtype=torch.int64)

    def _restore(self, state: dict[str, Any]) -> None:
        self.step_count = state["step_count"]
        self.optimizer_steps, self.reached = state["optimizer_steps"], range(*state["reached"])
        self.system.load_state(state["system"], self.step_count)
        self.optimizer = make_optimizer(self.system.parameter_groups(), self.schedule)
        self.optimizer.load_state_dict(state["optimizer"])
        self._curriculum.order = state["curriculum"]
        if any(index >= len(self.scene.splits["train"]) for index in self._curriculum.order):
            raise LookupError("an image that this dataset doesn't have")
        skipped, in_a_row = state["skipped"]
        weight = state.get("averages_weight", 1.0)  # checkpoints of earlier versions lack it
        self._meter.load(skipped, in_a_row, state["averages"], weight)
        self.rollbacks = state["rollbacks"]
        for generator, stored in zip(self._generators(), state["generators"], strict=True):
            generator.set_state(stored)

    @property
    def is_skipping(self) -> bool:
        """Whether the last step was skipped."""
        self._meter.read()
        return self._meter.skipped_in_a_row > 0

    @property
    def lr_factor(self) -> float:
        """Factor of all learning rates."""
        return ROLLBACK_LR**self.rollbacks

    @property
    def images_per_step(self) -> float:
        """Images that take about as long to evaluate as a step takes."""
        size = self.config.run.batch_size
        return size if self._rays is None else RENDERED_PER_STEP * size * self._rays.images_per_batch

    @property
    def bytes_of_images(self) -> int:
        """What all images take in memory; halves of training images, too, if some are still drawn at half the size."""
        frames = (frame for split in self.scene.splits.values() for frame in split)
        training = self.scene.splits["train"]
        halves = (frame.halved() for frame in training if self.schedule.halves(frame.camera.width, self.step_count))
        return bytes_of(frames) + bytes_of(halves)

    def _generators(self) -> list[torch.Generator]:
        return [self._generator, *self.system.generators()]

    def _render_and_backward(self, groups: Sequence[ParamGroup]) -> list[ViewGradients]:
        """Render the next batch and differentiate the loss of each image, on a CPU in parallel."""
        size = self.config.run.batch_size
        first = self.optimizer_steps * size
        drawn = [(self._next(number), self._next_background(), number) for number in range(first, first + size)]
        if size == 1 or not self._is_on_host:
            return [self._differentiate(groups, *view) for view in drawn]
        return list(self._workers.map(lambda view: self._differentiate(groups, *view), drawn))

    @functools.cached_property
    def _workers(self) -> ThreadPoolExecutor:
        """Each runs torch on one thread: splitting small matrix products over cores is slower."""
        return ThreadPoolExecutor(self.config.run.threads, "image", torch.set_num_threads, (1,))

    @sharing_cores()
    def _differentiate(
        self, groups: Sequence[ParamGroup], frame: Frame | RayBatch, background: Tensor, number: int
    ) -> ViewGradients:
        """Of the image or batch of this number since the start of the run."""
        run, moment = self.config.run, self._moment(number)
        background = to_device(background, run.device)
        if isinstance(frame, RayBatch):
            assert isinstance(self.system, RaySystem)
            target = Target.of_pixels(frame.rgba, background)
            return differentiate(groups, None, self.system.ray_loss(frame.rays, target, background, moment), target)
        assert not isinstance(self.system, RaySystem)
        is_halved = self.schedule.halves(frame.camera.width, self.step_count)
        image = self._training_images.image(frame, is_halved=is_halved)
        frame = frame.halved() if is_halved else frame
        target = Target.over(image, background)
        with trunk_precision("float32" if self._is_on_host else run.gpu_precision):
            view = self.system.loss(frame, target, background, moment)
        return differentiate(groups, frame, view, target)

    def _next(self, number: int) -> Frame | RayBatch:
        if self._rays is not None:
            return self._rays.batch(number, self.config.run.seed + ROLLBACK_SEED * self.rollbacks)
        return self._curriculum.next(number, self.step_count, self._generator)

    def _moment(self, number: int) -> Moment:
        seeds = np.random.SeedSequence([self.config.run.seed, self.rollbacks, number])
        return Moment(self.step_count, torch.Generator().manual_seed(int(seeds.generate_state(1)[0])))

    def _next_background(self) -> Tensor:
        if self.config.data.background == "random":
            return torch.rand(3, generator=self._generator)
        return torch.tensor(self.background)

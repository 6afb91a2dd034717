"""One training run in memory: do a step, judge the model, save everything and go on from there."""

import functools
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.utils import clip_grad_norm_, get_total_norm

from msdgs_serve.scene.errors import MsdgsError
from msdgs_serve.threads import sharing_cores
from msdgs_train.datasets import Frame, SceneData, composite
from msdgs_train.density.strategy import make_strategy, reseed
from msdgs_train.engine.averaging import WeightAverage
from msdgs_train.engine.config import TrainConfig
from msdgs_train.engine.curriculum import Curriculum, TrainingSample
from msdgs_train.engine.optimizer import learning_rates, make_optimizer, replace_values, set_learning_rates
from msdgs_train.evaluation.metrics import ImageMetrics, mean_metrics, psnr_from_mse, quality
from msdgs_train.gaussians import model_file as checkpoint
from msdgs_train.gaussians.canonical import CanonicalGaussians
from msdgs_train.gaussians.model import MIN_SCALE, DynamicGaussians, PosedGaussians, SceneBounds
from msdgs_train.losses.photometric import masked_l1, photometric_loss, pooled_l1
from msdgs_train.losses.rigidity import stretch
from msdgs_train.rendering.rasterize import RasterizationInfo, rasterize

MAX_SKIPPED_IN_A_ROW = 20
ROLLBACK_RATE = 0.5  # of the learning rates, each time that training goes back to a checkpoint
ROLLBACK_SEED = 1_000_003  # added to the seed of the images' order
MAX_FIELD_GRADIENT = 1.0  # norm; 0.05 to 0.6 is usual
SMOOTHING = 0.98  # of the loss and PSNR that are shown: an average over about 50 steps
BOUNDS_TIMES = 9
MAX_IMAGE_CACHE_BYTES = 2 << 30  # bytes
NEW_FRAME_LR_MULTIPLIER = (
    8.0  # times the way of motions, where only they learn: what is fast has far to go before the next image
)
VISIBLE_OPACITY = 0.05
OUTSIDE_BOUNDS = 0.01


class TrainingDiverged(MsdgsError):
    """The loss or its gradient has not been finite for many steps in a row."""


class StepResult(NamedTuple):
    """What one step has shown, averaged over the last steps, and what it has cost."""

    step: int  # counted from 1
    loss: float
    psnr: float  # dB, on training images
    gaussians: int
    skipped: int  # steps of the whole run whose loss or gradient was not finite
    clamped_scales: int  # Gaussians a scale of which came out at 0 or below in this step, and was set to e^-20


class _Shot(NamedTuple):
    """What one image has to say about the model."""

    lesson: TrainingSample
    loss: float
    squared_error: float
    gradients: tuple[Tensor | None, ...]  # of the model's parameters, in their order
    info: RasterizationInfo
    clamped_scales: int


class EvaluatedFrame(NamedTuple):
    """A held-out frame: as captured and as rendered, [H, W, 3] in [0, 1]."""

    frame: Frame
    target: Tensor
    rgb: Tensor
    quality: ImageMetrics


class Trainer:
    """The model, its optimiser, its density control and the order of the images, moved on by `step`."""

    def __init__(self, config: TrainConfig, scene: SceneData) -> None:
        torch.set_num_threads(config.threads if config.batch_size == 1 else 1)
        self.config = config
        self.scene = scene
        self.frames = scene.splits["train"]
        self.step_count = 0
        self.skipped = 0
        self.rollbacks = 0
        self._skipped_in_a_row = 0
        self._averages: tuple[float, float] | None = None  # loss, squared error
        self._generator = torch.Generator().manual_seed(config.seed)
        self._curriculum = Curriculum(config, self.frames, scene.time_range)
        self._scene_half_size = config.scene_half_size or scene.scene_half_size
        self.model = _new_model(config, scene, SceneBounds(self._scene_half_size, scene.time_range))
        self.optimizer = make_optimizer(self.model, config)
        self.density = make_strategy(config, self._extent(), len(self.model.gaussians))
        self._mean = WeightAverage(config.ema_steps)
        self._set_eps2d(1)
        self._pairs_generator = torch.Generator().manual_seed(config.seed + 2)

    def step(self) -> StepResult:
        """Render the next images' views, pull the model towards them, and control density."""
        self._prepare()
        set_learning_rates(self.optimizer, self._learning_rates())
        shots = self._shots()
        self._set_gradients(shots)
        loss = sum(shot.loss for shot in shots) / len(shots)
        self.step_count += 1
        if self._is_finite(loss):
            # one outlier would stay in Adam's second moment, and slow the field down, for a thousand steps
            clip_grad_norm_(self._field_parameters(), MAX_FIELD_GRADIENT)
            self._move(shots)
            whole = [shot for shot in shots if shot.lesson.subject == "everything"]
            if whole:
                losses, errors = ([getattr(s, name) for s in whole] for name in ("loss", "squared_error"))
                self._average(sum(losses) / len(whole), sum(errors) / len(whole))
            for shot in whole:
                if shot.info.means2d_grads is not None:
                    camera = shot.lesson.frame.camera
                    self.density.accumulate(shot.info.means2d_grads, shot.info.radii, camera.width, camera.height)
        self.density.after_step(self.model.gaussians, self.optimizer, self.step_count)
        if self.config.averages_at(self.step_count):
            self._mean.add(self.model)
        else:
            self._mean.reset()
        average_loss, average_error = self._averages or (float("nan"), float("nan"))
        return StepResult(
            self.step_count,
            average_loss,
            psnr_from_mse(average_error),
            len(self.model.gaussians),
            self.skipped,
            max(shot.clamped_scales for shot in shots),
        )

    def _shots(self) -> list[_Shot]:
        """Render the next images' views and differentiate the loss of each, side by side."""
        first = self.step_count * self.config.batch_size
        drawn = [
            (
                self._curriculum.next(number, self._generator),
                self._next_background(),
                _offspring(self._pairs_generator),
            )
            for number in range(first, first + self.config.batch_size)
        ]
        if len(drawn) == 1:
            return [self._shoot(*drawn[0])]
        return list(self._workers.map(lambda image: self._shoot(*image), drawn))

    @functools.cached_property
    def _workers(self) -> ThreadPoolExecutor:
        """Each runs torch on one core: small matrices shared among cores leave most of them waiting."""
        return ThreadPoolExecutor(self.config.threads, "image", torch.set_num_threads, (1,))

    @sharing_cores()
    def _shoot(self, lesson: TrainingSample, background: Tensor, pairs: torch.Generator) -> _Shot:
        target = self._image(lesson.frame, background)
        posed = self._pose(self.model, lesson.t)
        rgb, _, info = rasterize(*posed, lesson.frame.camera, background, self.model.rasterizer)
        c = self.config
        if lesson.subject == "stillness":
            loss = masked_l1(rgb, target, c.l1_weight)
        else:
            loss = photometric_loss(rgb, target, c.l1_weight, c.mse_fraction) + self._regularizers(posed, lesson, pairs)
        if lesson.subject == "motion" and c.pooled_l1_weight:
            loss = loss + c.pooled_l1_weight * pooled_l1(rgb, target)
        gradients = self._gradients(loss, lesson)
        squared_error = float((rgb.detach() - target).square().mean())
        return _Shot(lesson, loss.item(), squared_error, gradients, info, self._count_clamped_scales(posed))

    def _gradients(self, loss: Tensor, lesson: TrainingSample) -> tuple[Tensor | None, ...]:
        """Of all parameters, in their order; None of those that the lesson doesn't teach."""
        motion = {id(parameter) for parameter in self.model.deformation.parameters()}
        if lesson.subject == "stillness" and self.model.gaussians.skinning_logits is not None:
            motion.add(id(self.model.gaussians.skinning_logits))
        taught = [
            lesson.subject == "everything" or (id(p) in motion) == (lesson.subject == "motion")
            for p in self._parameters()
        ]
        learning = [p for p, learns in zip(self._parameters(), taught, strict=True) if learns]
        found = iter(torch.autograd.grad(loss, learning, allow_unused=True))
        return tuple(next(found) if learns else None for learns in taught)

    def _set_gradients(self, shots: list[_Shot]) -> None:
        """The mean over the images that teach each parameter, added up in their order, so that the same seed gives
        the same bits."""
        for parameter, *gradients in zip(self._parameters(), *(shot.gradients for shot in shots), strict=True):
            known = [gradient for gradient in gradients if gradient is not None]
            parameter.grad = sum(known[1:], known[0]) / len(known) if known else None

    def _parameters(self) -> list[nn.Parameter]:
        return [p for p in self.model.parameters() if p.requires_grad]

    @torch.no_grad()
    def evaluate(self, split: str) -> Iterator[EvaluatedFrame]:
        """Render and judge each frame of a split, one after the other."""
        background = torch.tensor(self.config.evaluation_background)
        for frame in self.scene.splits[split]:
            target = self._image(frame, background)
            posed = self._pose(self.eval_model, frame.t)
            rgb, _, _ = rasterize(*posed, frame.camera, background, self.eval_model.rasterizer)
            rgb = rgb.clamp(0, 1)
            yield EvaluatedFrame(frame, target, rgb, quality(rgb, target))

    def evaluate_mean(self, split: str) -> ImageMetrics:
        """The mean PSNR and SSIM of a split."""
        return mean_metrics([evaluated.quality for evaluated in self.evaluate(split)])

    def save_checkpoint(self, path: Path, seconds: float) -> None:
        """Write all that a bit-exact continuation needs; `seconds` is the time trained so far. Atomic."""
        state = {
            "config": self.config.to_dict(),
            "step_count": self.step_count,
            "seconds": seconds,
            "skipped": (self.skipped, self._skipped_in_a_row),
            "rollbacks": self.rollbacks,
            "averages": self._averages,
            "generators": [generator.get_state() for generator in self._generators],
            "order": self._curriculum.order,
            "model": self.model.state_dict(),
            "mean": self._mean.state(),
            "optimizer": self.optimizer.state_dict(),
            "density": self.density.state(),
        }
        checkpoint.save_atomic(path, state)

    def load_checkpoint(self, path: Path) -> float:
        """Go on from a checkpoint, of a run with the same settings; returns the seconds trained before."""
        state: dict[str, Any] = checkpoint.load(path)
        _resize(self.model.gaussians, state["model"])
        self.model.load_state_dict(state["model"])
        self.optimizer = make_optimizer(self.model, self.config)
        self.optimizer.load_state_dict(state["optimizer"])
        self.step_count, self._averages = state["step_count"], state["averages"]
        self._set_eps2d(self.step_count)
        self._mean.load_state(state.get("mean") if self.config.averages_at(self.step_count) else None, self.model)
        self._curriculum.order = state["order"]
        self.skipped, self._skipped_in_a_row = state["skipped"]
        self.rollbacks = state.get("rollbacks", 0)
        for generator, stored in zip(self._generators, state["generators"], strict=True):
            generator.set_state(stored)
        self.density.load_state(state["density"])
        return float(state["seconds"])

    @property
    def is_skipping(self) -> bool:
        """Whether the last step was skipped."""
        return self._skipped_in_a_row > 0

    def retry_after(self, diverged: "Trainer") -> None:
        """Take another way than a trainer that has diverged from here: half its rates, another order of images."""
        self.skipped, self._skipped_in_a_row = diverged.skipped, 0
        self.rollbacks = diverged.rollbacks + 1
        self._generator.manual_seed(self.config.seed + ROLLBACK_SEED * self.rollbacks)
        self._curriculum.order = torch.empty(0, dtype=torch.int64)

    @property
    def lr_factor(self) -> float:
        """What the learning rates of the settings are multiplied by."""
        return ROLLBACK_RATE**self.rollbacks

    def save_model(self, path: Path) -> None:
        """Write the model with what a service needs to show it: times, background, bounds and cameras."""
        info = checkpoint.SceneInfo(
            time_range=self.scene.time_range,
            background=self.config.evaluation_background,
            bounds=self._bounds(),
            cameras=[_camera_entry(frame) for frame in self.scene.splits.get("test") or self.frames[:20]],
        )
        checkpoint.save_model(path, self.eval_model, info, self.step_count)

    @property
    def _generators(self) -> tuple[torch.Generator, ...]:
        return self._generator, self.density.generator, self._pairs_generator

    @torch.no_grad()
    def _move(self, shots: list[_Shot]) -> None:
        """A step of the optimiser; frames that train motion alone move it `NEW_FRAME_LR_MULTIPLIER` times as far.

        Stretches don't: what is out of its place would shrink until nothing pulls at it, before it gets there.
        """
        bases, ahead = self.model.bases, [shot.lesson.t for shot in shots if shot.lesson.subject == "motion"]
        if bases is None or not ahead:
            self.optimizer.step()
            return
        curves, read = (bases.shifts, bases.turns), torch.zeros(len(bases.shifts), dtype=torch.bool)
        for t in ahead:
            read[bases.knots_at(torch.tensor(t))[0]] = True
        before = [curve[read] for curve in curves]
        self.optimizer.step()
        for curve, old in zip(curves, before, strict=True):
            curve[read] = torch.lerp(old, curve[read], NEW_FRAME_LR_MULTIPLIER)

    def _learning_rates(self) -> dict[str, float]:
        rates = learning_rates(self.config, self.step_count)
        return {group: self.lr_factor * rate for group, rate in rates.items()}

    def _field_parameters(self) -> list[nn.Parameter]:
        """Of layers that are networks or grids, where one weight serves many Gaussians at many times."""
        bases = set() if self.model.bases is None else set(self.model.bases.parameters())
        return [p for p in self.model.deformation.parameters() if p not in bases]

    def _count_clamped_scales(self, posed: PosedGaussians) -> int:
        if self.config.model.delta_space == "raw":
            return 0
        return int((posed.scales <= MIN_SCALE).any(dim=1).sum())

    def _pose(self, model: DynamicGaussians, t: float) -> PosedGaussians:
        deform, sh_degree = self.parts_in_use
        return model.pose(t, deform=deform, sh_degree=sh_degree)

    @property
    def eval_model(self) -> DynamicGaussians:
        """The one that is judged, shown and saved: the mean of the last steps, before it begins the last step's."""
        return self.model if self._mean.model is None else self._mean.model

    def _set_eps2d(self, step: int) -> None:
        self.model.config = replace(self.model.config, eps2d=self.config.eps2d_at(step))

    @property
    def parts_in_use(self) -> tuple[bool, int]:
        """Whether Gaussians are deformed yet, and the degree of their spherical harmonics up to now."""
        return self._deforms(), min(self.step_count // self.config.sh_degree_interval, self.config.model.sh_degree)

    def _deforms(self) -> bool:
        return self.step_count >= self.config.deform_start_step and len(self.model.deformation) > 0

    def _regularizers(self, posed: PosedGaussians, lesson: TrainingSample, pairs: torch.Generator) -> Tensor | float:
        """What is asked besides likeness to the images: few and small Gaussians, rigid motion, smooth grids."""
        c, total = self.config, 0.0
        if c.density_strategy == "mcmc":
            total = c.opacity_reg * posed.opacities.mean() + c.scale_reg * posed.scales.mean()
        if not self._deforms():
            return total
        if c.rigidity_weight:
            means = self.model.gaussians.means
            stretched = stretch(means, posed.means, self._scene_half_size, pairs)
            total = total + c.rigidity_weight * stretched
        bases = self.model.bases
        if bases is not None:
            time = torch.tensor(lesson.t, dtype=posed.means.dtype)
            total = total + c.arap_weight * bases.strains(time)
            if lesson.subject != "motion":  # a ball that an image shows from above would fall on, straight ahead
                total = total + c.motion_smoothness_weight * bases.bends(time)
        for grid in self.model.plane_grids():
            for weight, roughness in (
                (c.time_smoothness_weight, grid.time_smoothness),
                (c.l1_time_planes_weight, grid.l1_time_planes),
                (c.plane_tv_weight, grid.plane_tv),
                (c.plane_smoothness_weight, grid.plane_smoothness),
            ):
                total = total + weight * roughness() if weight else total
        return total

    def _prepare(self) -> None:
        """What is due before this step: sowing, placing motions, widening what layers know of time, dilation."""
        step, gaussians = self.step_count, self.model.gaussians
        self._set_eps2d(step + 1)
        if step == self.config.static_steps and self.config.num_reseeded:
            reseed(gaussians, self.optimizer, self.config, self._scene_half_size)
            self.density.reset(len(gaussians))
        bases = self.model.bases
        if bases is not None and step == self.config.deform_start_step:
            logits, ids = bases.place(gaussians.means.detach(), gaussians.raw_opacities.detach().sigmoid())
            replace_values(self.optimizer, gaussians, "skinning_logits", logits)
            replace_values(self.optimizer, gaussians, "node_ids", ids)
        before, after = (self._curriculum.window(k) for k in (step - 1, step))
        if before < after and self._curriculum.is_first_pass(step):
            for part in [*self.model.plane_grids(), *([bases] if bases is not None else [])]:
                part.on_window(before, after)

    def _next_background(self) -> Tensor:
        if self.config.background == "random":
            return torch.rand(3, generator=self._generator)
        return torch.tensor(self.config.evaluation_background)

    @functools.cached_property
    def _images(self) -> dict[Path, np.ndarray]:
        return {}

    def _image(self, frame: Frame, background: Tensor) -> Tensor:
        """[H, W, 3] over a background. Pixels stay in memory as uint8 RGBA, read when first wanted, up to a bound."""
        rgba = self._images.get(frame.image_path)
        if rgba is None:
            rgba = frame.load_rgba()
            if (len(self._images) + 1) * rgba.nbytes <= MAX_IMAGE_CACHE_BYTES:
                self._images[frame.image_path] = rgba
        return torch.from_numpy(composite(rgba, background.numpy()))

    def _is_finite(self, loss: float) -> bool:
        gradients = [p.grad for p in self.model.parameters() if p.grad is not None]
        if bool(torch.isfinite(loss + get_total_norm(gradients, foreach=True))):
            self._skipped_in_a_row = 0
            return True
        self.skipped += 1
        self._skipped_in_a_row += 1
        if self._skipped_in_a_row >= MAX_SKIPPED_IN_A_ROW:
            raise TrainingDiverged(
                f"the loss or its gradient was not finite for {MAX_SKIPPED_IN_A_ROW} steps in a row, up to step "
                f"{self.step_count}"
            )
        return False

    def _average(self, loss: float, squared_error: float) -> None:
        old = self._averages or (loss, squared_error)
        self._averages = (
            SMOOTHING * old[0] + (1 - SMOOTHING) * loss,
            SMOOTHING * old[1] + (1 - SMOOTHING) * squared_error,
        )

    def _extent(self) -> float:
        """Radius of the cameras' positions, as 3D Gaussian Splatting measures a scene; one camera has none."""
        positions = np.array([frame.camera.position for frame in self.frames])
        radius = 1.1 * float(np.linalg.norm(positions - positions.mean(axis=0), axis=1).max())
        return radius if radius > 0 else self._scene_half_size

    @torch.no_grad()
    def _bounds(self) -> list[list[float]]:
        """Corners of the box that holds the centres of the Gaussians that can be seen, over the times of the scene.

        The outermost on each side are left out: some are flung far away, where no image shows them.
        """
        first, last = self.scene.time_range
        boxes = []
        for t in np.linspace(first, last, BOUNDS_TIMES):
            posed = self._pose(self.eval_model, float(t))
            means = posed.means[posed.opacities >= VISIBLE_OPACITY]
            if len(means):
                boxes.append(torch.quantile(means, torch.tensor([OUTSIDE_BOUNDS, 1 - OUTSIDE_BOUNDS]), dim=0))
        if not boxes:
            return [[-self._scene_half_size] * 3, [self._scene_half_size] * 3]
        stacked = torch.stack(boxes)
        return [stacked[:, 0].amin(dim=0).tolist(), stacked[:, 1].amax(dim=0).tolist()]


def _offspring(generator: torch.Generator) -> torch.Generator:
    """One that a thread may draw from by itself."""
    return torch.Generator().manual_seed(int(torch.randint(2**62, (), generator=generator)))


def _new_model(config: TrainConfig, scene: SceneData, bounds: SceneBounds) -> DynamicGaussians:
    sizes = config.model
    rest = (sizes.sh_degree, sizes.embedding_dim, config.seed, sizes.motions)
    if scene.points is not None and len(scene.points):
        points = (scene.points, scene.point_colors)
        gaussians = CanonicalGaussians.from_sparse_points(*points, config.init_num_pts, *rest)
    else:
        gaussians = CanonicalGaussians.random_in_cube(config.init_num_pts, bounds.scene_half_size, *rest)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        return DynamicGaussians(sizes, gaussians, bounds)


def _resize(gaussians: nn.Module, state: dict[str, Tensor]) -> None:
    for name, parameter in list(gaussians.named_parameters()):
        rows = len(state[f"gaussians.{name}"])
        new = parameter.new_empty(rows, *parameter.shape[1:])
        setattr(gaussians, name, nn.Parameter(new, parameter.requires_grad))


def _camera_entry(frame: Frame) -> dict[str, Any]:
    camera = frame.camera
    entry = {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy", "width", "height")}
    return {"name": frame.name, **entry, "camera_to_world": camera.camera_to_world.tolist(), "t": frame.t}

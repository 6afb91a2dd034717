"""Systems of Gaussians with any support and any chain of layers; published ones differ in their settings."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from msdgs_serve.rasterizer import RasterizerOptions
from msdgs_serve.scene import Camera, InvalidInput
from msdgs_train.datasets import Frame, SceneData
from msdgs_train.density.gradient import GradientStrategy
from msdgs_train.density.mcmc import MCMCStrategy
from msdgs_train.density.strategy import DensityStrategy
from msdgs_train.engine.averaging import WeightAverage
from msdgs_train.engine.optimizer import restart
from msdgs_train.engine.schedule import Schedule
from msdgs_train.gaussians import model_file
from msdgs_train.gaussians.bounds import first_by_pose, scene_bounds, scene_scale, views_of
from msdgs_train.gaussians.canonical import CanonicalGaussians
from msdgs_train.gaussians.config import ModelConfig
from msdgs_train.gaussians.model import DynamicGaussians, PosedGaussians, canonical_points
from msdgs_train.gaussians.scene_info import SceneInfo
from msdgs_train.gaussians.surgery import RowSurgery
from msdgs_train.layers.base import SceneBounds
from msdgs_train.layers.parameters import LearningRate, ParamGroup, constant
from msdgs_train.losses.photometric import photometric_loss
from msdgs_train.poses.refinement import PoseRefinement
from msdgs_train.rendering.rasterize import rasterize
from msdgs_train.supports.base import CanonicalPoints
from msdgs_train.systems.base import Moment, ViewLoss
from msdgs_train.systems.targets import Target


class GaussianSplatting:
    """A model of Gaussians, its density control and its average; implements `System`."""

    def __init__(self, schedule: Schedule, scene: SceneData) -> None:
        config = schedule.config
        given = config.data.scene_half_size  # in world units
        self.scene_half_size = given / scene.scene_to_world.scale if given else scene.scene_half_size
        cameras = [frame.camera for frame in scene.splits["train"]]
        self.distinct = first_by_pose(cameras, lambda camera: camera)
        self.scale, views = scene_scale(cameras) or self.scene_half_size, len(self.distinct)
        self.is_rig = 2 * views <= len(cameras)
        if self.is_rig and views > 1:
            config = config.updated(layers=[layer.for_rig(len(cameras) // views) for layer in config.model.layers])
            schedule = schedule._replace(config=config)
        self.several_per_time = 2 * len({frame.t for frame in scene.splits["train"]}) <= len(cameras)
        self.schedule, self.config, self.scene = schedule, config, scene
        bounds, gaussians = SceneBounds(self.scene_half_size, scene.time_range), self.new_gaussians()
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.run.seed)
            self.model = DynamicGaussians(config.model, gaussians, bounds).to(config.run.device)
        self.max_gaussians = config.density.bound(max(camera.width * camera.height for camera in cameras))
        self.density = self.new_density(schedule, self.max_gaussians)
        self.average: WeightAverage[DynamicGaussians] = WeightAverage(schedule.ema_steps)
        self.poses = None
        if config.poses.pose_opt:
            if config.model.quat_space == "raw":
                raise InvalidInput("config.pose_opt", "off with --quat-space raw, which no camera can turn", True)
            self.poses = PoseRefinement(config.poses, scene.splits["train"]).to(config.run.device)

    def new_gaussians(self) -> CanonicalGaussians:
        """Those that a run starts with, on the CPU."""
        config, scene = self.config, self.scene
        rest = (config.model.sh_degree, config.run.seed, config.model.attributes())
        count = config.density.init_num_pts
        if scene.points is not None and len(scene.points):
            return CanonicalGaussians.from_sparse_points(scene.points, scene.point_colors, count, *rest)
        least = config.density.init_min_views * len(self.distinct)
        in_view = (lambda points: views_of(points, self.distinct) >= least) if least else None
        gray = config.density.init_gray
        return CanonicalGaussians.random_in_cube(count, self.scene_half_size, *rest, in_view, gray)

    def new_density(self, schedule: Schedule, max_gaussians: int) -> DensityStrategy:
        """Density control of the present Gaussians from the start of a schedule."""
        if schedule.config.density.density_strategy == "mcmc":
            return MCMCStrategy.start(schedule, max_gaussians)
        return GradientStrategy.start(schedule, max_gaussians, self.scale, self.size, self.distinct, self.is_rig)

    @property
    def size(self) -> int:
        return len(self.model.gaussians)

    @property
    def eval_model(self) -> DynamicGaussians:
        """The one that is evaluated, shown and saved: the average, or the last step's before it begins."""
        return self.model if self.average.model is None else self.average.model

    def parameter_groups(self) -> list[ParamGroup]:
        o, g = self.config.optimizer, self.model.gaussians
        rates: dict[str, LearningRate] = {
            "means": LearningRate(o.means_lr_init, o.means_lr_final, until=o.means_lr_until_fraction),
            "log_scales": constant(o.scales_lr),
            "raw_quats": constant(o.quats_lr),
            "raw_opacities": constant(o.opacities_lr),
            "sh_dc": constant(o.sh_dc_lr),
            "sh_rest": constant(o.sh_rest_lr),
        }
        own = [ParamGroup(name, [g.get_parameter(name)], lr) for name, lr in rates.items()]
        return own + self.model.motion_groups() + ([self.poses.parameter_group()] if self.poses else [])

    def milestones(self, num_steps: int) -> list[int]:
        return []

    @torch.no_grad()
    def before_step(self, optimizer: torch.optim.Optimizer, steps: range) -> None:
        schedule, surgery = self.schedule, RowSurgery(self.model.gaussians, optimizer)
        if self.poses:
            self.poses.center()
        if schedule.deform_start_step in steps:
            if len(self.model.deformation):
                self.model.support.on_deform_start(self.model.gaussians, surgery)
                points = self.model.support.points(self.model.gaussians.means)
                for layer in self.model.deformation:
                    layer.on_deform_start(points)
            if schedule.restart_step:
                restart(optimizer, self.parameter_groups())
        before, after = schedule.window(steps.start - 1), schedule.window(steps.stop - 1)
        if before < after:
            for layer in self.model.deformation:
                layer.on_window(before, after)

    def loss(self, frame: Frame, target: Target, background: Tensor, moment: Moment) -> ViewLoss:
        step, c, t = moment.step, self.config.loss, self._time(frame.t, moment)
        points = canonical_points(self.model.gaussians.rows())
        motions = self._motions(points, t, step)
        posed = self._pose(self.model, t, step, motions, points)
        seen = self.poses.seen(posed, frame.camera) if self.poses and step >= self.schedule.static_steps else posed
        options = self._options(step + 1)
        how = {
            "absolute_gradients": self.config.density.absolute_gradients,
            "raw_quats": self.config.model.quat_space == "raw",
        }
        rgb, alpha, info = rasterize(*seen, frame.camera, background, options, **how)
        loss = photometric_loss(rgb, target.rgb, 1 - c.ssim_lambda, c.mse_fraction, target.mask)
        loss = loss + self._regularizers(posed, motions, points, t, moment)
        if c.alpha_weight:
            loss = loss + c.alpha_weight * target.alpha_error(alpha)
        shows_all = (
            target.facts.shows_all and not self.config.model.opacity_head
        )  # else opacity 0 at this time hides some
        return ViewLoss(loss, rgb, info, shows_all)

    def after_step(self, optimizer: torch.optim.Optimizer, steps: range, views: list[tuple[Frame, ViewLoss]]) -> None:
        for frame, view in views:
            self.density.accumulate(view.screen, frame.camera.width, frame.camera.height, view.shows_all)
        self.density.after_step(RowSurgery(self.model.gaussians, optimizer), steps)
        if self.schedule.averages_at(steps.stop - 1):
            self.average.add(self.model, len(steps))
        else:
            self.average.reset()

    @torch.no_grad()
    def render(self, camera: Camera, t: float, background: Tensor, step: int) -> Tensor:
        posed = self._pose(self.eval_model, t, step)
        return rasterize(*posed, camera, background, self._options(step))[0].clamp(0, 1)

    def generators(self) -> list[torch.Generator]:
        return [self.density.generator]

    def state(self) -> dict[str, Any]:
        return {
            "model": self.model.state_dict(),
            "average": self.average.state(),
            "density": self.density.state(),
            **({"poses": self.poses.state_dict()} if self.poses else {}),
        }

    def load_state(self, state: dict[str, Any], step: int) -> None:
        _resize(self.model.gaussians, state["model"])
        self.model.load_state_dict(state["model"])
        average = state["average"] if self.schedule.averages_at(step) else None
        self.average.load_state(average, self.model)
        self.density.load_state(state["density"])
        if self.poses:
            self.poses.load_state_dict(state["poses"])

    @torch.no_grad()
    def save(self, path: Path, step: int) -> None:
        """Write `model.pt`: the model with time range, background, bounds and cameras."""
        model = self.eval_model
        bounds = scene_bounds(lambda t: self._pose(model, t, step), self.scene.time_range, self.scene_half_size)
        info = SceneInfo.of_run(self.scene, self.config.data, bounds)
        model_file.save_model(path, model, info, step, self._stored_config(model, step))

    def _stored_config(self, model: DynamicGaussians, step: int) -> ModelConfig:
        return replace(model.config, eps2d=self.schedule.eps2d(step))

    def _options(self, step: int) -> RasterizerOptions:
        """Options of the rasterizer in a step, counted from 1."""
        return self.model.rasterizer._replace(eps2d=self.schedule.eps2d(step))

    def _time(self, t: float, moment: Moment) -> float:
        """The time of an image, with noise while there is some. Deformable-3D-Gaussians' distance between images is 1
        over those left in the pass, whose number is as good as uniform."""
        size = self.schedule.time_noise(moment.step)
        if not size:
            return t
        first, last = self.scene.time_range
        left = torch.randint(1, len(self.scene.splits["train"]) + 1, (), generator=moment.generator)
        return t + float(torch.randn((), generator=moment.generator) / left) * size * (last - first)

    def _pose(
        self,
        model: DynamicGaussians,
        t: float,
        step: int,
        motions: Any = None,
        points: CanonicalPoints | None = None,
    ) -> PosedGaussians:
        degree, deform = self.schedule.sh_degree(step), self.schedule.deforms(step)
        return model.pose(t, deform=deform, sh_degree=degree, motions=motions, points=points)

    def _motions(self, points: CanonicalPoints, t: float, step: int) -> Any:
        """Those of the support, once for the pose and the regularizers."""
        if not (self.schedule.deforms(step) and len(self.model.deformation)):
            return None
        return self.model.support.motions(self.model.deformation, points.means, points.means.new_full((), t))

    def _regularizers(
        self, posed: PosedGaussians, motions: Any, points: CanonicalPoints, t: float, moment: Moment
    ) -> Tensor | float:
        """The weighted sum of the regularizers of density control, support and layers."""
        pruning = self.schedule.prunes_hidden(moment.step, several_per_time=self.several_per_time)
        terms = list(self.config.density.regularizers(posed.opacities, posed.scales, pruning=pruning).values())
        if motions is not None:
            support, time = self.model.support, posed.means.new_full((), t)
            terms += support.regularizers(motions, points, time, moment.generator).values()
            moved = support.points(points.means)
            for layer in self.model.deformation:
                terms += layer.regularizers(moved, time, moment.generator).values()
        return sum(terms, 0.0)


def _resize(gaussians: nn.Module, state: dict[str, Tensor]) -> None:
    for name, parameter in list(gaussians.named_parameters()):
        rows = len(state[f"gaussians.{name}"])
        new = parameter.new_empty(rows, *parameter.shape[1:])
        setattr(gaussians, name, nn.Parameter(new, parameter.requires_grad))

"""Training of SC-GS in two stages: its nodes, then the scene on them."""

from dataclasses import replace
from typing import Any, cast

import torch
from torch import Tensor, nn

from msdgs_serve.scene import Camera
from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.datasets import Frame, SceneData
from msdgs_train.density.gradient import GradientStrategy
from msdgs_train.engine.config import TrainConfig
from msdgs_train.engine.schedule import Schedule
from msdgs_train.gaussians.canonical import CanonicalGaussians
from msdgs_train.gaussians.config import ModelConfig
from msdgs_train.gaussians.model import DynamicGaussians, PosedGaussians, canonical_points
from msdgs_train.gaussians.scale_space import activated_scales
from msdgs_train.gaussians.surgery import MOMENTS, RowSurgery
from msdgs_train.layers.arrays import to_device
from msdgs_train.layers.mlp import MLPLayer
from msdgs_train.layers.parameters import ParamGroup, constant
from msdgs_train.layers.placement import farthest_points
from msdgs_train.supports.base import CanonicalPoints
from msdgs_train.supports.scgs import NodeRows, SCGSConfig, SCGSSupport
from msdgs_train.systems.base import Moment, Target, ViewLoss
from msdgs_train.systems.gaussian_splatting import GaussianSplatting
from msdgs_train.systems.scgs.losses import (
    acceleration_loss,
    elastic_loss,
    near_time,
    rigidity_loss,
    sampled_times,
    trajectories,
)
from msdgs_train.systems.scgs.settings import SCGSSettings

CHOICE_TIMES = 16
"""Times at which positions are compared when nodes are chosen."""
MOST_PER_NODE = 16
"""Gaussians of the first stage per node, at most, if the dataset has sparse points."""
ELASTIC_TIMES, ELASTIC_NEIGHBORS, RIGID_TIMES, RIGID_WIDTH = 8, 2, 2, 0.05
HEAD_DEVIATIONS = {"means": 1e-5, "scales": 1e-8, "quats": 1e-5, "local_quats": 1e-4}
"""Standard deviations of the initial weights of heads."""


class SCGS(GaussianSplatting):
    """Gaussian splatting whose schedule is that of the current stage, with steps counted from its start."""

    def __init__(self, schedule: Schedule, scene: SceneData) -> None:
        config = schedule.config
        if not (isinstance(config.model.support, SCGSConfig) and config.model.layers):
            raise InvalidInput("model.support", "scgs, with a layer, for sc-gs", config.model.support.kind)
        if config.density.density_strategy != "gradient":
            raise InvalidInput("config.density_strategy", "gradient with sc-gs", config.density.density_strategy)
        if config.curriculum.restart_at_motion:
            expected = "off with sc-gs, whose second stage starts Adam, its rates and density control again"
            raise InvalidInput("config.restart_at_motion", expected, True)
        super().__init__(schedule, scene)
        self.step, self.stages = 0, self._stages(schedule.num_steps)
        self.first_steps = self.stages[0].num_steps
        for layer in self.model.deformation:
            if isinstance(layer, MLPLayer):
                initialize_network(layer, config.run.seed)
        self._start_nodes()
        self._enter()

    @property
    def settings(self) -> SCGSSettings:
        """Those of SC-GS alone."""
        return cast(SCGSSettings, self.config.own)

    @property
    def support(self) -> SCGSSupport:
        """That of the trained model."""
        return cast(SCGSSupport, self.model.support)

    @property
    def is_second(self) -> bool:
        """Whether the second stage has begun."""
        return self.support.has_nodes

    def _stages(self, num_steps: int) -> tuple[Schedule, Schedule]:
        """Those of a run of so many steps."""
        first = max(round(self.settings.node_stage_fraction * num_steps), 1)
        return (
            Schedule.from_config(_first_stage(self.config, self.settings, first)),
            Schedule.from_config(self.config.updated(steps=max(num_steps - first, 1))),
        )

    def milestones(self, num_steps: int) -> list[int]:
        """The choice of nodes, the second stage, and in it new nodes and bands of color."""
        first, second = self._stages(num_steps)
        bands = [band * second.sh_degree_interval for band in range(self.config.model.sh_degree + 1)]
        densified = round(self.settings.densify_nodes_fraction * second.num_steps)
        in_second = [first.num_steps + step for step in (*bands, densified)]
        return [round(self.settings.node_choice_fraction * first.num_steps), *in_second]

    def _local(self, step: int) -> int:
        """A step of the run, counted from the start of the stage."""
        return step - self.first_steps if self.is_second else step

    def _enter(self) -> None:
        """Follow the schedule of the stage that the nodes are in, with density control from its start."""
        self.schedule, most = self.stages[self.is_second], self.max_gaussians
        per_node = self.settings.gaussians_per_node or (MOST_PER_NODE if self.scene.points is not None else None)
        if not self.is_second and per_node:
            most = max(min(most, per_node * self.support.config.num_nodes), self.size)
        self.density = self.new_density(self.schedule, most)

    @torch.no_grad()
    def _start_nodes(self) -> None:
        """Replace the first Gaussians by gray ones among them that are far from each other, and place nodes there."""
        gaussians = self.model.gaussians
        rows = farthest_points(gaussians.means, min(self.support.config.num_nodes, self.size), 0)[0]
        chosen = {name: parameter.detach()[rows] for name, parameter in gaussians.named_parameters()}
        chosen["sh_dc"] = torch.zeros_like(chosen["sh_dc"])
        self.model.gaussians = CanonicalGaussians(**chosen)
        self.support.place(self.model.gaussians.means, self.model.gaussians.means, 0)

    def parameter_groups(self) -> list[ParamGroup]:
        """Rates decay over parts of the second stage, from the start of either."""
        groups, step, steps = super().parameter_groups(), self._local(self.step), self.stages[1].num_steps
        until = self.settings.network_until_fraction
        rates = {g.name: g.lr._replace(until=until) if g.name.startswith("layers.") else g.lr for g in groups}
        return [group._replace(lr=constant(rates[group.name].at(step, steps, 0))) for group in groups]

    @torch.no_grad()
    def before_step(self, optimizer: torch.optim.Optimizer, steps: range) -> None:
        self.step = steps.stop - 1  # none may have been reached
        if not self.is_second and round(self.settings.node_choice_fraction * self.first_steps) in steps:
            self._choose_nodes(optimizer)
        if not self.is_second and self.first_steps in steps:
            self._begin_second(optimizer)
        if self.poses:
            self.poses.center()

    def _choose_nodes(self, optimizer: torch.optim.Optimizer) -> None:
        """Keep the Gaussians whose positions over time are farthest from each other, and make them nodes."""
        means, before = self.model.gaussians.means.detach(), self.support.parameter_groups()[0].params
        first, last = self.scene.time_range
        times = torch.linspace(first, last, CHOICE_TIMES, device=means.device)
        paths = trajectories(self.model.deformation, means, times).permute(1, 0, 2).flatten(1)
        generator = torch.Generator().manual_seed(self.config.run.seed + 2)
        chosen = self.support.place(means, paths, int(torch.randint(len(means), (), generator=generator)))
        self._replace_nodes(optimizer, before, None)
        self._replace_gaussians(optimizer, chosen, {n: p[:0] for n, p in self.model.gaussians.named_parameters()})
        self._enter()

    def _begin_second(self, optimizer: torch.optim.Optimizer) -> None:
        """Nodes are where the Gaussians that are left have come to; new Gaussians follow them."""
        self.support.nodes.copy_(self.model.gaussians.means)
        self.support.set_placed(True)
        none = torch.zeros(0, dtype=torch.int64, device=self.support.nodes.device)
        fresh = self.new_gaussians().to(self.config.run.device)
        self._replace_gaussians(optimizer, none, dict(fresh.named_parameters()))
        self._enter()

    def _replace_gaussians(self, optimizer: torch.optim.Optimizer, kept: Tensor, added: dict[str, Tensor]) -> None:
        """Keep and add rows; all moments start anew."""
        RowSurgery(self.model.gaussians, optimizer).replace_rows(kept, {n: v.detach() for n, v in added.items()})
        for parameter in self.model.gaussians.parameters():
            optimizer.state.pop(parameter, None)

    def _replace_nodes(self, optimizer: torch.optim.Optimizer, before: list[nn.Parameter], kept: Tensor | None) -> None:
        """Give the optimizer the support's new parameters: the rows `kept` of those before keep their moments, which
        start anew for all others."""
        group = next(group for group in optimizer.param_groups if group["name"] == "support.nodes")
        group["params"] = self.support.parameter_groups()[0].params
        for old, new in zip(before, group["params"], strict=True):
            state = optimizer.state.pop(old, None)
            if state is None or kept is None:
                continue
            for moment in MOMENTS:
                state[moment] = torch.cat([state[moment][kept], torch.zeros_like(new[len(kept) :])])
            optimizer.state[new] = state

    def loss(self, frame: Frame, target: Target, background: Tensor, moment: Moment) -> ViewLoss:
        moment = moment._replace(step=self._local(moment.step))
        if not self.is_second:  # a random background shows what should be empty
            drawn = to_device(torch.rand(3, generator=moment.generator), background.device)
            clear = 1 - target.alpha[..., None] * (1 / 255)
            target = target._replace(rgb=target.rgb + clear * (drawn - background))
            background = drawn
        view = super().loss(frame, target, background, moment)
        return view._replace(loss=view.loss + self._node_losses(frame.t, moment))

    def _is_warm(self, step: int) -> bool:
        """Whether motion is trained in a step of the stage."""
        own = self.settings
        fraction = own.warm_up_fraction if self.is_second else own.node_warm_up_fraction
        return step >= round(fraction * self.schedule.num_steps)

    def _node_losses(self, t: float, moment: Moment) -> Tensor | float:
        """The weighted sum of the losses of the nodes' motion."""
        if not self._is_warm(moment.step):
            return 0.0
        own, g, (start, end) = self.settings, moment.generator, self.scene.time_range
        span = (end - start) or 1.0
        part = moment.step / self.schedule.num_steps
        weight, total = own.rigidity_weight(part) if self.is_second else own.node_rigidity_weight, 0.0
        if not self.is_second:
            apart = span / len(self.scene.splits["train"])
            near = sampled_times(near_time(t, apart, g), apart, ELASTIC_TIMES, g)
            places = self.support.nodes, self.support.node_hypers
            weights, ids = self.support.weights(*places, ELASTIC_NEIGHBORS + 1)
            total = own.elastic_weight * elastic_loss(self._positions(near), weights[:, 1:], ids[:, 1:])
            three = near_time(t, 3 * apart, g) + 3 * apart * torch.tensor([-1.0, 0.0, 1.0])
            total = total + own.acceleration_weight * acceleration_loss(self._positions(three))
        if weight:
            center = start + span * float(torch.rand((), generator=g))
            times = sampled_times(center, RIGID_WIDTH * span, RIGID_TIMES, g)
            total = total + weight * rigidity_loss(self._positions(times), g)
        return total

    def _positions(self, times: Tensor) -> Tensor:
        """[T, M, 3] of the nodes."""
        nodes = self.support.nodes
        return trajectories(self.model.deformation, nodes, to_device(times.to(nodes.dtype), nodes.device))

    @torch.no_grad()
    def after_step(self, optimizer: torch.optim.Optimizer, steps: range, views: list[tuple[Frame, ViewLoss]]) -> None:
        local = range(self._local(steps.start), self._local(steps.stop))
        is_due = round(self.settings.densify_nodes_fraction * self.schedule.num_steps) in local
        if self.is_second and is_due and self.settings.densify_nodes_fraction:
            self._densify_nodes(optimizer)
        super().after_step(optimizer, local, views)
        if not self.is_second:  # one size for all
            scales = self.model.gaussians.log_scales
            scales.fill_(scales.mean())

    def _densify_nodes(self, optimizer: torch.optim.Optimizer) -> None:
        """Remove nodes that no Gaussian follows, and add some where gradients are large."""
        density, points = cast(GradientStrategy, self.density), canonical_points(self.model.gaussians.rows())
        gradients = density.gradients / density.counts.clamp(min=1)
        kept, added = self.support.densified(points, gradients, density.config.grow_grad2d)
        before, rows = self.support.parameter_groups()[0].params, self.support.rows()
        self.support.set_rows(NodeRows(*(torch.cat([a[kept], b]) for a, b in zip(rows, added, strict=True))))
        self._replace_nodes(optimizer, before, kept)

    def render(self, camera: Camera, t: float, background: Tensor, step: int) -> Tensor:
        return super().render(camera, t, background, self._local(step))

    def load_state(self, state: dict[str, Any], step: int) -> None:
        stored = NodeRows(*(state["model"][f"support.{name}"] for name in NodeRows._fields))
        self.support.set_rows(NodeRows(*(rows.to(self.support.nodes) for rows in stored)))
        self.support.set_placed(bool(state["model"]["support.is_placed"]))
        self.step = step
        self._enter()
        super().load_state(state, self._local(step))

    def _stored_config(self, model: DynamicGaussians, step: int) -> ModelConfig:
        """With as many nodes as there are."""
        config = super()._stored_config(model, step)
        return replace(config, support=replace(self.support.config, num_nodes=len(self.support.nodes)))

    def _pose(
        self,
        model: DynamicGaussians,
        t: float,
        step: int,
        motions: Any = None,
        points: CanonicalPoints | None = None,
    ) -> PosedGaussians:
        posed = super()._pose(model, t, step, motions, points)
        if self.is_second:
            return posed
        scale = activated_scales(model.gaussians.log_scales.mean())
        return posed._replace(scales=scale.expand_as(posed.scales))

    def _motions(self, points: CanonicalPoints, t: float, step: int) -> Any:
        """Without gradients until motion is trained."""
        with torch.set_grad_enabled(torch.is_grad_enabled() and self._is_warm(step)):
            return super()._motions(points, t, step)


def _first_stage(config: TrainConfig, own: SCGSSettings, steps: int) -> TrainConfig:
    return config.updated(
        model=replace(config.model, sh_degree=0),
        steps=steps,
        refine_start_fraction=0.0,
        refine_stop_fraction=own.node_choice_fraction,
        refine_every_fraction=own.node_refine_every_fraction,
        reset_every_fraction=own.node_reset_every_fraction,
    )


@torch.no_grad()
def initialize_network(layer: MLPLayer, seed: int) -> None:
    """He's uniform initialization of hidden layers, torch's of the network of time, and heads of nearly 0."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        if layer.config.time_network:
            layer.time_hidden.reset_parameters()
            layer.time_output.reset_parameters()
        for linear in (layer.first, *cast(list[nn.Linear], list(layer.trunk))):
            nn.init.kaiming_uniform_(linear.weight, nonlinearity="relu")
            nn.init.zeros_(linear.bias)
        nn.init.zeros_(layer.heads.bias)
        for name, columns in layer.outputs.columns.items():
            layer.heads.weight[columns].normal_(std=HEAD_DEVIATIONS.get(name, HEAD_DEVIATIONS["means"]))

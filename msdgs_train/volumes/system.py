"""Training of a volume on batches of rays; implements `RaySystem`."""

from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from msdgs_serve.scene import Camera
from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.datasets import Frame, SceneData
from msdgs_train.datasets.config import DataConfig
from msdgs_train.datasets.rays import Rays
from msdgs_train.engine.config import LoggingConfig, RunConfig, TrainConfig, differences
from msdgs_train.engine.optimizer import restart
from msdgs_train.engine.schedule import Schedule
from msdgs_train.gaussians.config import ModelConfig
from msdgs_train.gaussians.scene_info import SceneInfo
from msdgs_train.layers.parameters import ParamGroup
from msdgs_train.systems.base import Moment, ViewLoss
from msdgs_train.systems.targets import Target
from msdgs_train.volumes.config import VolumeConfig
from msdgs_train.volumes.march import march
from msdgs_train.volumes.model_file import render, save_volume

BASE = TrainConfig().updated(
    model=ModelConfig(layers=(), embedding_dim=0),
    background="white",
    static_fraction=0.0,
    window_full_fraction=0.0,
    adam_beta2=0.99,
    adam_eps=1e-8,
)
"""Settings that all volumes share: all images take part from the start."""
USED = frozenset({*RunConfig().names(), *DataConfig().names(), *LoggingConfig().names(), "adam_beta2", "adam_eps"})
USED -= {"gpu_image_memory", "gpu_precision", "scene_half_size"}
IGNORED = frozenset({"init_num_pts", "max_gaussians"})
"""Numbers of Gaussians, which comparisons set for all systems."""


class VolumeSystem:
    """A volume whose grids grow during the run."""

    def __init__(self, schedule: Schedule, scene: SceneData) -> None:
        config = schedule.config
        assert isinstance(config.own, VolumeConfig)
        _refuse_unused(config)
        self.schedule, self.config, self.scene, self.settings = schedule, config, scene, config.own.sized(scene)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.run.seed)
            self.model = self.settings.build(self.settings.box_of(scene)).to(config.run.device)
        self._step = 0

    @property
    def size(self) -> int:
        return self.model.size

    @property
    def rays_per_batch(self) -> int:
        return self.settings.rays

    @torch.no_grad()
    def hits(self, rays: Rays) -> Tensor:
        return self.model.hits(rays)

    def parameter_groups(self) -> list[ParamGroup]:
        return self.model.parameter_groups(self._step / self.schedule.num_steps)

    def milestones(self, num_steps: int) -> list[int]:
        return [round(at * num_steps) for at, _ in self.model.changes()]

    def before_step(self, optimizer: torch.optim.Optimizer, steps: range) -> None:
        before, self._step = list(self.model.parameters()), steps.stop - 1
        for at, (_, change) in zip(self.milestones(self.schedule.num_steps), self.model.changes(), strict=True):
            if at in steps:
                change()
        if any(now is not then for now, then in zip(self.model.parameters(), before, strict=True)):
            restart(optimizer, self.parameter_groups())

    def ray_loss(self, rays: Rays, target: Target, background: Tensor, moment: Moment) -> ViewLoss:
        marched = march(self.model, rays, background, moment.generator)
        error = (marched.rgb - target.rgb).square().mean()
        regularizers = self.model.regularizers(marched, target.rgb, moment.step / self.schedule.num_steps)
        return ViewLoss(error + regularizers, marched.rgb)

    def after_step(
        self, optimizer: torch.optim.Optimizer, steps: range, views: list[tuple[Frame, ViewLoss]]
    ) -> None: ...

    def render(self, camera: Camera, t: float, background: Tensor, step: int) -> Tensor:
        return render(self.model, camera, t, background)

    def generators(self) -> list[torch.Generator]:
        return []

    def state(self) -> dict[str, Any]:
        return {"model": self.model.state_dict()}

    def load_state(self, state: dict[str, Any], step: int) -> None:
        self.model.load_grown(state["model"])
        self._step = step

    def save(self, path: Path, step: int) -> None:
        info = SceneInfo.of_run(self.scene, self.config.data, self.model.corners.tolist())
        save_volume(path, self.config.run.system, self.model, self.settings, info, step)


def _refuse_unused(config: TrainConfig) -> None:
    for name, _, wanted in differences(BASE, config):
        if name not in USED | IGNORED:
            raise InvalidInput(f"config.{name}", f"not given: {config.run.system} doesn't use it", wanted)

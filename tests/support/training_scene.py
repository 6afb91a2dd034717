"""A moving scene small enough to train on in a test: three blobs, one of which crosses the image."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch

from msdgs_serve.rasterizer import rasterize
from msdgs_serve.scene import Camera
from msdgs_serve.scene.camera import OPENGL_TO_OPENCV, orbit
from msdgs_train.datasets import SceneData, load_scene
from msdgs_train.datasets.common.images import write_png
from msdgs_train.engine.config import TrainConfig
from msdgs_train.engine.metrics_log import to_bytes
from msdgs_train.engine.optimizer import make_optimizer, set_learning_rates
from msdgs_train.engine.run import Observer
from msdgs_train.engine.schedule import Schedule
from msdgs_train.engine.trainer import StepResult, Trainer
from msdgs_train.gaussians.canonical import CanonicalGaussians
from msdgs_train.gaussians.config import ModelConfig
from msdgs_train.gaussians.surgery import RowSurgery
from msdgs_train.layers.base import LayerConfig
from msdgs_train.layers.bodies import BodiesConfig
from msdgs_train.layers.hash4d import Hash4DConfig
from msdgs_train.layers.mlp import MLPConfig
from msdgs_train.layers.parameters import ParamGroup, constant
from msdgs_train.layers.plane import PlaneConfig
from msdgs_train.layers.spline import SplineConfig
from msdgs_train.supports.nodes import NodesConfig
from msdgs_train.systems.gaussian_splatting import GaussianSplatting
from msdgs_train.systems.registry import systems
from msdgs_train.systems.targets import ImageFacts, TrainingImage
from msdgs_train.volumes.config import VolumeConfig
from tests.support.scenes import gaussians_of

SIZE = 24
FOV = 40.0
GAUSSIANS = [name for name, entry in systems().items() if not isinstance(entry.config.own, VolumeConfig)]
"""Systems that are made of Gaussians."""
FEW = ["--threads=1", "--init-num-pts=60", "--max-gaussians=90"]
"""Options of a small run on the command line."""

MLP = MLPConfig(width=16, depth=2, xyz_frequencies=3, time_frequencies=2, time_width=8, time_features=4)
PLANE = PlaneConfig(features=4, resolution=6, time_resolution=5, width=8)
TINY_GRIDS: dict[str, Any] = {"levels": 3, "log2_rows": 8, "canonical_levels": 3, "canonical_log2_rows": 8, "width": 8}
"""Sizes of a hash layer."""
VOLUMES: dict[str, dict[str, Any]] = {
    "hexplane-slim": {"voxels": 12**3, "first_voxels": 8**3, "times": 4, "first_times": 3},
    "tineuvox-s": {"voxels": 16**3, "width": 8},
    "tineuvox-b": {"voxels": 16**3, "width": 8, "channels": 3},
}
"""Sizes of volumes, by preset."""
BODIES = BodiesConfig(num_knots=8, num_bodies=3)
HASH4D = Hash4DConfig(**TINY_GRIDS, depth=1)
SMALL_MODEL = ModelConfig(sh_degree=1, layers=(MLP, MLP), embedding_dim=4)
SPLINES = ModelConfig(
    sh_degree=1, support=NodesConfig(num_nodes=4), layers=(SplineConfig(num_knots=8),), embedding_dim=0
)
MODELS = {
    "mlp": SMALL_MODEL,
    "mlp on nodes": dataclasses.replace(SMALL_MODEL, support=NodesConfig(num_nodes=6)),
    "mixed on nodes": dataclasses.replace(
        SMALL_MODEL,
        support=NodesConfig(num_nodes=6),
        layers=(BODIES, SplineConfig(num_knots=8, shading=True), PLANE, MLP),
    ),
    "hash4d": dataclasses.replace(SMALL_MODEL, layers=(HASH4D,), scale_space="linear"),
    "mixed on gaussians": dataclasses.replace(SMALL_MODEL, layers=(PLANE, MLP)),
}


def small_config(**changes: Any) -> TrainConfig:
    """A run of 24 steps that goes through the static phase, densification, opacity reset and every SH degree."""
    values = {
        "steps": 24, "threads": 1, "model": SMALL_MODEL, "init_num_pts": 60, "max_gaussians": 90,
        "static_fraction": 0.25, "static_window_fraction": 0.0, "sh_degree_fraction": 6 / 24,
        "refine_start_fraction": 4 / 24, "refine_every_fraction": 4 / 24, "refine_stop_fraction": 0.8,
        "grow_grad2d": 1e-5, "reset_every_fraction": 9 / 24, "log_every": 1, "eval_every": 10, "checkpoint_every": 0,
    }  # fmt: skip
    return TrainConfig().updated(**{**values, **changes})


def parameter_groups(gaussians: CanonicalGaussians) -> list[ParamGroup]:
    """One group per attribute, all with one rate."""
    return [ParamGroup(name, [p], constant(1e-3)) for name, p in gaussians.named_parameters()]


def with_moments(gaussians: CanonicalGaussians, schedule: Schedule) -> RowSurgery:
    """After a step of Adam without a gradient; the first moment of row k is k + 1, the second 10 times as large."""
    optimizer = make_optimizer(parameter_groups(gaussians), schedule)
    for p in gaussians.parameters():
        p.grad = torch.zeros_like(p)
    optimizer.step()
    for p in gaussians.parameters():
        rows = torch.arange(1, len(p) + 1, dtype=torch.float32).reshape(-1, *[1] * (p.ndim - 1))
        optimizer.state[p]["exp_avg"] += rows
        optimizer.state[p]["exp_avg_sq"] += 10 * rows
    return RowSurgery(gaussians, optimizer)


def moment_rows(surgery: RowSurgery, name: str) -> list[float]:
    """The first moments of a parameter, by row."""
    state = surgery.optimizer.state[surgery.gaussians.get_parameter(name)]
    first, second = (state[m].reshape(len(surgery.gaussians), -1)[:, 0] for m in ("exp_avg", "exp_avg_sq"))
    assert torch.equal(second, 10 * first)
    return first.tolist()


def _narrow(layer: LayerConfig) -> LayerConfig:
    if isinstance(layer, MLPConfig):
        return dataclasses.replace(layer, width=16, time_width=8, time_features=4)
    if isinstance(layer, PlaneConfig):
        return dataclasses.replace(layer, features=4, resolution=6, time_resolution=5, width=8)
    if isinstance(layer, Hash4DConfig):
        return dataclasses.replace(layer, **TINY_GRIDS)
    return layer


def shrunk(config: TrainConfig) -> TrainConfig:
    """The same system with few Gaussians, few steps and narrow layers; most steps are after the static phase."""
    support = config.model.support
    model = dataclasses.replace(
        config.model,
        support=dataclasses.replace(support, num_nodes=20) if support.moves_nodes else support,  # type: ignore
        layers=tuple(map(_narrow, config.model.layers[:3])),
        embedding_dim=min(config.model.embedding_dim, 4),
    )
    static = 0.25 if config.curriculum.static_fraction else 0.0
    return config.updated(
        model=model, steps=12, static_fraction=static, threads=2, init_num_pts=60, max_gaussians=90,
        refine_start_fraction=4 / 12, refine_every_fraction=4 / 12, sh_degree_fraction=4 / 12,
    )  # fmt: skip


def training_image(rgba: np.ndarray, mask: np.ndarray | None = None) -> TrainingImage:
    """An image, [H, W, 4] uint8, on the CPU; `mask`, [H, W] bool, is true where pixels count."""
    counts = None if mask is None else torch.from_numpy(mask)
    return TrainingImage(torch.from_numpy(rgba), counts, ImageFacts.of(rgba, mask))


def splatting(trainer: Trainer) -> GaussianSplatting:
    """The system of a trainer, as `GaussianSplatting`."""
    assert isinstance(trainer.system, GaussianSplatting)
    return trainer.system


def learning_rates(config: TrainConfig, data: Path, step: int) -> dict[str, float]:
    """The rates at a step, by the name of the group."""
    trainer = Trainer(config, load_scene(data))
    groups = trainer.system.parameter_groups()
    set_learning_rates(trainer.optimizer, groups, trainer.schedule, step, 1.0)
    return {group["name"]: group["lr"] for group in trainer.optimizer.param_groups}


def trained(config: TrainConfig, scene: SceneData, steps: int) -> Trainer:
    """A trainer after so many steps."""
    trainer = Trainer(config, scene)
    for _ in range(steps):
        trainer.step()
    return trainer


class StopAfter(Observer):
    """Ends a run as Ctrl-C does."""

    def __init__(self, step: int) -> None:
        self.last, self.limit = 0, step

    def step(self, result: StepResult, seconds: float) -> None:
        self.last = result.step

    def should_stop(self) -> bool:
        return self.last >= self.limit


def _flat(tree: Any, prefix: str = "") -> dict[str, Any]:
    if isinstance(tree, dict):
        items = list(tree.items())
    elif isinstance(tree, list | tuple):
        items = list(enumerate(tree))
    else:
        return {prefix: tree}
    return {name: value for key, child in items for name, value in _flat(child, f"{prefix}/{key}").items()}


def state_of(run: Path) -> dict[str, Any]:
    """All values of its checkpoint but the seconds, by path."""
    state = _flat(torch.load(run / "checkpoint.pt", weights_only=True))
    return {name: value for name, value in state.items() if name != "/seconds"}


def assert_same_bits(one: dict[str, Any], other: dict[str, Any]) -> None:
    assert one.keys() == other.keys()
    for name, value in one.items():
        if isinstance(value, torch.Tensor):
            assert torch.equal(value, other[name]), name
        else:
            assert value == other[name], name


def write_scene(folder: Path, *, train: int = 7, test: int = 2) -> Path:
    """In D-NeRF layout."""
    for split, count, shift in (("train", train, 0.0), ("test", test, 0.5), ("val", 1, 0.3)):
        (folder / split).mkdir(parents=True)
        frames = [_write_frame(folder, f"{split}/r_{i:03d}", (i + shift) / count) for i in range(count)]
        contents = {"camera_angle_x": math.radians(FOV), "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(contents))
    return folder


def _write_frame(folder: Path, name: str, t: float) -> dict:
    pose = orbit(np.zeros(3), 4.0, 360 * t, 25.0, np.array([0.0, 0.0, 1.0]))
    camera = Camera.from_fov(pose, SIZE, SIZE, FOV)
    blobs = gaussians_of(
        [[1.2 * t - 0.6, 0, 0.4], [0.4, 0.5, -0.3], [-0.5, -0.3, -0.3]],
        scales=0.3,
        opacities=0.95,
        rgb=[[0.9, 0.2, 0.1], [0.1, 0.8, 0.2], [0.2, 0.2, 0.9]],
    )
    rgb = rasterize(blobs, camera, background=(1.0, 1.0, 1.0)).rgb
    write_png(folder / f"{name}.png", to_bytes(rgb))
    return {"file_path": f"./{name}", "time": t, "transform_matrix": (pose @ OPENGL_TO_OPENCV).tolist()}

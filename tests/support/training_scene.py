"""A moving scene small enough to train on in a test: three blobs, one of which crosses the image."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch

from msdgs_serve.rasterizer import rasterize
from msdgs_serve.scene import Camera
from msdgs_serve.scene.camera import OPENGL_TO_OPENCV, orbit
from msdgs_train.datasets.common.images import write_png
from msdgs_train.engine.config import TrainConfig
from msdgs_train.engine.metrics_log import to_bytes
from msdgs_train.engine.run import Observer
from msdgs_train.engine.trainer import StepResult
from msdgs_train.gaussians.model import ModelConfig
from tests.support.scenes import gaussians_of

SIZE = 24
FOV = 40.0

SMALL_MODEL = ModelConfig(
    sh_degree=1, layers=("mlp", "mlp"), width=16, depth=2, xyz_frequencies=3, time_frequencies=2, time_width=8,
    time_features=4, embedding_dim=4,
)  # fmt: skip

SHARED_MOTIONS = ModelConfig(sh_degree=1, layers=("bases",), num_nodes=4, num_knots=8, embedding_dim=0)


def small_config(**changes: Any) -> TrainConfig:
    """A run of 24 steps that goes through warm-up, densification, opacity reset and every SH degree."""
    values = {
        "steps": 24, "threads": 1, "model": SMALL_MODEL, "init_num_pts": 60, "max_gaussians": 90,
        "static_fraction": 0.25, "static_window_fraction": 0.0, "sh_degree_interval": 6, "refine_start": 4,
        "refine_every": 4, "refine_stop_fraction": 0.8,
        "grow_grad2d": 1e-5, "reset_every": 9, "log_every": 1, "eval_every": 10, "checkpoint_every": 0,
    }  # fmt: skip
    return TrainConfig(**{**values, **changes})


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
    """All that is in its checkpoint but the seconds, by place."""
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

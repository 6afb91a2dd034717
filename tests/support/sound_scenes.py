"""Sound scene files of every plan and every kind of layer, small."""

from collections.abc import Iterator
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import torch

from export.importers.sequence import Frames, sequence_scene
from export.jobs.bake import bake
from export.plans.registry import build
from msdgs_train.gaussians.canonical import CanonicalGaussians
from msdgs_train.gaussians.config import ModelConfig
from msdgs_train.gaussians.model import DynamicGaussians
from msdgs_train.layers.mlp import MLPConfig
from msdgs_train.layers.plane import PlaneConfig
from msdgs_train.layers.spline import SplineConfig
from msdgs_train.supports.nodes import NodesConfig
from tests.support.models import SCENE
from tests.support.scene_files import write_scene
from tests.support.splat_files import some_gaussians

MLP, PLANE, SPLINE = MLPConfig(32, 3, time_width=16, time_features=8), PlaneConfig(), SplineConfig()
NODES = NodesConfig(num_nodes=16)
MODELS = {
    "mlp": ModelConfig(layers=(MLP, MLP)),
    "plane": ModelConfig(layers=(PLANE,)),
    "mixed": ModelConfig(layers=(MLP, PLANE), scale_space="linear", modulation_targets=("means", "scales", "quats")),
    "spline on nodes": ModelConfig(support=NODES, layers=(SPLINE,)),
    "mixed on nodes": ModelConfig(support=NODES, layers=(PLANE, SPLINE, MLP), weights=False, embedding_dim=0),
    "static": ModelConfig(layers=()),
}
PLANS = ("network", "prefix:1", "int8", "lowrank:4", "lowrank:0.05", "keyframes:8", "keyframes:0.05")

COUNT = 20
"""Gaussians of each."""


@cache
def sound_scenes() -> dict[str, bytes]:
    """By name."""
    return dict([*_exported(), *_of_sequences(), *_by_hand()])


def _exported() -> Iterator[tuple[str, bytes]]:
    for name, config in MODELS.items():
        baked = bake(_model(config), SCENE, "0" * 64)
        for plan in PLANS if config.layers else PLANS[:1]:
            if plan != "int8" or MLP in config.layers:  # of others no product is of width × width
                yield f"{name} {plan}", build(plan, baked).SerializeToString()


def _model(config: ModelConfig) -> DynamicGaussians:
    """All of its parameters random."""
    gaussians = CanonicalGaussians.random_in_cube(COUNT, 1.3, config.sh_degree, 0, config.attributes())
    with torch.random.fork_rng(), torch.no_grad():
        torch.manual_seed(0)
        model = DynamicGaussians(config, gaussians)
        for parameter in model.parameters():
            if parameter.requires_grad and parameter is not gaussians.means:
                parameter += 0.05 * torch.randn_like(parameter)
    return model


def _of_sequences() -> Iterator[tuple[str, bytes]]:
    for name, counts in (("blended frames", (COUNT, COUNT)), ("switched frames", (COUNT, COUNT - 1))):
        frames = tuple(some_gaussians(count) for count in counts)
        sequence = Frames(frames, 0, "dilate", blended=name == "blended frames")
        yield name, sequence_scene(sequence, "0" * 64).SerializeToString()


def _by_hand() -> Iterator[tuple[str, bytes]]:
    """Written without the exporter, of another version of the operator set; constant outputs are computed."""
    with TemporaryDirectory() as folder:
        for steps in (False, True):
            yield (
                f"by hand, {'with' if steps else 'without'} steps",
                write_scene(Path(folder) / "scene.onnx", steps=steps).read_bytes(),
            )

"""Small models: random ones without zeros, a moving object, and their export."""

import hashlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from msdgs_export.bake import bake
from msdgs_export.jobs.verify import TIMES, TOLERANCE
from msdgs_export.jobs.write import Exported, write_scene
from msdgs_export.plans.base import BASELINE
from msdgs_export.plans.registry import build
from msdgs_export.precision.assess import assess
from msdgs_train.gaussians.canonical import CanonicalGaussians
from msdgs_train.gaussians.config import ModelConfig
from msdgs_train.gaussians.model import DynamicGaussians
from msdgs_train.gaussians.model_file import SceneInfo, load_model, save_model
from msdgs_train.layers.base import LayerConfig
from msdgs_train.layers.bodies import BodiesConfig
from msdgs_train.layers.hash4d import Hash4DConfig
from msdgs_train.layers.mlp import MLPConfig, MLPLayer
from msdgs_train.layers.plane import PlaneConfig
from msdgs_train.layers.spline import SplineConfig
from msdgs_train.supports.nodes import NodesConfig, NodesSupport

torch.set_num_threads(1)
"""Tests run in parallel, and waiting OpenMP threads spin."""

CAMERA = {
    "fx": 50.0,
    "fy": 50.0,
    "cx": 32.0,
    "cy": 24.0,
    "width": 64,
    "height": 48,
    "camera_to_world": [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, -4.0], [0.0, 0.0, 0.0, 1.0]],
}


def moved_camera(x: float) -> dict[str, Any]:
    """`CAMERA` moved to the right."""
    first, *others = CAMERA["camera_to_world"]
    return CAMERA | {"camera_to_world": [[*first[:3], x], *others]}


SCENE = SceneInfo(
    time_range=(0.0, 1.0),
    background=(1.0, 1.0, 1.0),
    bounds=[[-1.3] * 3, [1.3] * 3],
    cameras=[{"name": f"r_{i:03}", "t": i / 29, **moved_camera(i / 1000)} for i in range(30)],
)


MLP = MLPConfig(width=32, depth=3, time_width=16, time_features=8)
PLANE = PlaneConfig()
SPLINE = SplineConfig(num_knots=3)
SHADING = SplineConfig(num_knots=3, shading=True)
BODIES = BodiesConfig(num_knots=4, num_bodies=3)
HASH4D = Hash4DConfig(
    levels=3,
    coarsest=(4, 4, 3),
    finest=(7, 7, 5),
    log2_rows=7,
    canonical_levels=3,
    canonical_coarsest=(4, 4, 4),
    canonical_finest=(17, 17, 17),
    canonical_log2_rows=8,
    width=16,
    depth=1,
    reach=1.2,
)
"""Of both kinds of grids, the finest level or more are hashed."""
SMALL_LAYERS: dict[str, LayerConfig] = {layer.kind: layer for layer in (MLP, PLANE, SPLINE, HASH4D, BODIES)}
NODES = NodesConfig(num_nodes=4)


def small_config(**changes: Any) -> ModelConfig:
    """Two layers of width 32; `layers` may name a kind of `SMALL_LAYERS` instead of its settings."""
    values: dict[str, Any] = {"layers": ("mlp", "mlp"), "embedding_dim": 8} | changes
    layers = [SMALL_LAYERS[layer] if isinstance(layer, str) else layer for layer in values.pop("layers")]
    return ModelConfig(layers=tuple(layers), **values)


def random_model(count: int = 300, seed: int = 0, noise: float = 0.05, **config: Any) -> DynamicGaussians:
    """A model with normal noise added to all initial parameters."""
    settings = small_config(**config)
    gaussians = CanonicalGaussians.random_in_cube(count, 1.3, settings.sh_degree, seed, settings.attributes())
    with torch.random.fork_rng(), torch.no_grad():
        torch.manual_seed(seed)
        model = DynamicGaussians(settings, gaussians)
        if isinstance(model.support, NodesSupport):
            _place_nodes(model.support, gaussians)
            for layer in model.deformation:
                layer.on_deform_start(model.support.nodes)
        for parameter in model.parameters():
            if parameter.requires_grad and parameter is not gaussians.means:
                parameter += noise * torch.randn_like(parameter)
    return model


def _place_nodes(support: NodesSupport, gaussians: CanonicalGaussians) -> None:
    """Place nodes among the Gaussians, or at random if there are none; Gaussians follow the nearest."""
    if len(gaussians) == 0:
        support.nodes.normal_()
        return
    logits, ids = support.initialize_nodes(gaussians.means, gaussians.raw_opacities.sigmoid())
    gaussians.get_parameter("skinning_logits").copy_(logits)
    gaussians.get_parameter("node_ids").copy_(ids)


GROUND, OBJECT = 200, 40  # Gaussians of the moving object's scene, the ground's first
RISE = 0.3  # approximate speed of the object, scene units per unit of time


def moving_object(seed: int = 0, moves: bool = True, **config: Any) -> DynamicGaussians:
    """Static ground at x < 0.3, and an object at x > 0.9 that rises; without `moves`, no layer moves anything.

    It also has parts without effect: a second layer, SH bands of zeros, modulation of 1, and heads of scales and
    rotations that are zero.
    """
    settings = small_config(**({"layers": (replace(MLP, depth=1),) * 2, "sh_degree": 1} | config))
    generator = torch.Generator().manual_seed(seed)
    count = GROUND + OBJECT
    points = 2 * torch.rand(count, 3, generator=generator) - 1
    points[:GROUND, 0] = 0.3 - 1.2 * torch.rand(GROUND, generator=generator)
    points[GROUND:, 0] = 0.9 + 0.3 * torch.rand(OBJECT, generator=generator)
    colors = torch.rand(count, 3, generator=generator)
    gaussians = CanonicalGaussians.from_points(points, colors, settings.sh_degree, generator, settings.attributes())
    with torch.no_grad():
        gaussians.log_scales.fill_(-2.3)
        gaussians.raw_opacities.fill_(2.0)
        model = DynamicGaussians(settings, gaussians)
        for layer in model.deformation.layers:
            for parameter in layer.parameters():
                parameter.zero_()
        if moves:
            rise(model.deformation.layers[0])
    return model


def rise(layer: torch.nn.Module) -> None:
    """Make a layer of zeros move points at x > 0.8 upwards in proportion to the time."""
    assert isinstance(layer, MLPLayer)
    layer.time_hidden.weight[0, 0] = 1
    layer.time_output.weight[0, 0] = 1  # the first feature of time is the time
    layer.first.weight[0, 0] = 10
    layer.first.weight[0, layer.xyz_features] = 4
    layer.first.bias[0] = -8
    layer.first.weight[1, 0] = 10
    layer.first.bias[1] = -8
    layer.heads.weight[1, 0] = -RISE  # units 0 and 1 differ by 4 t where x > 0.8; the weight is a half
    layer.heads.weight[1, 1] = RISE


def saved(folder: Path, model: DynamicGaussians, info: SceneInfo = SCENE) -> Path:
    """Save a model as model.pt in a folder; return its path."""
    save_model(folder / "model.pt", model, info, 1)
    return folder / "model.pt"


STABILITY_TIMES = 3


def export_scene(
    checkpoint: Path,
    output: Path,
    *,
    tolerance: float = TOLERANCE,
    times: int = TIMES,
    on_time: Callable[[], object] = lambda: None,
) -> Exported:
    """Bake `checkpoint`, write it beside `output`, compare that file with the model, and only then move it there.

    An error leaves `output` unchanged. Raises `CheckpointInvalid`, `ModelNotExportable`,
    `PlanUnsafe`, `VerificationFailed`, or `SceneFileInvalid` where the written file breaks its contract.
    """
    loaded = load_model(checkpoint)
    with checkpoint.open("rb") as file:
        sha256 = hashlib.file_digest(file, "sha256").hexdigest()
    baked = bake(loaded.model, loaded.scene, sha256)
    assess(loaded.model, loaded.scene, times=STABILITY_TIMES).require(BASELINE)
    return write_scene(output, build(BASELINE, baked), loaded.model, tolerance=tolerance, times=times, on_time=on_time)

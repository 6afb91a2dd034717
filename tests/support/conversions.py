"""Scene files and their conversion to other formats."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.console import Console

from msdgs_export.bake import bake
from msdgs_export.exporters.command import convert
from msdgs_export.options import ConvertOptions
from msdgs_export.plans.registry import build
from msdgs_train.gaussians.model_file import SceneInfo
from tests.support.models import MLP, SCENE, random_model

QUIET = Console(quiet=True)


def scene_file(folder: Path, plan: str = "network", info: SceneInfo = SCENE, **config: Any) -> Path:
    """A scene of 300 Gaussians with a model of these settings."""
    settings: dict[str, Any] = {"layers": (replace(MLP, time_frequencies=2),) * 2} | config
    model = random_model(300, noise=0.02, **settings)
    file = folder / "scene.onnx"
    file.write_bytes(build(plan, bake(model, info, "0" * 64)).SerializeToString())
    return file


def run(scene: Path, out: Path, t: float | None = None, **options: Any) -> None:
    """`msdgs-convert`, without its output."""
    convert(ConvertOptions(scene, out, t, **options), QUIET)

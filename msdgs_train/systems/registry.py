"""Systems by name: default settings, and the class that builds and trains the model.

A system is one file in this folder, or a plugin, that calls `register_system`.
"""

from collections.abc import Callable
from typing import NamedTuple

from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.datasets import SceneData
from msdgs_train.engine.config import TrainConfig
from msdgs_train.engine.schedule import Schedule
from msdgs_train.layers.plugins import load_plugins
from msdgs_train.settings import OWN_SETTINGS
from msdgs_train.systems.base import ImageSystem, RaySystem

DEFAULT = "msdgs-nodes"


class SystemEntry(NamedTuple):
    """A system that `msdgs-train fit --preset NAME` trains."""

    name: str
    description: str  # a line of help
    config: TrainConfig
    build: Callable[[Schedule, SceneData], ImageSystem | RaySystem] | None = None  # None: Gaussians


_ENTRIES: dict[str, SystemEntry] = {}


def register_system(
    name: str,
    description: str,
    config: TrainConfig,
    build: Callable[[Schedule, SceneData], ImageSystem | RaySystem] | None = None,
) -> None:
    """Register a system under its name; it may have settings of its own in `config.own`.

    Raises `InvalidInput` if one of those has the name of another setting.
    """
    config.require_unique_names()
    OWN_SETTINGS[name] = type(config.own)
    _ENTRIES[name] = SystemEntry(name, description, config.updated(system=name), build)


def systems() -> dict[str, SystemEntry]:
    """All systems by name, those of plugins included; the default first."""
    load_plugins()
    return {DEFAULT: _ENTRIES[DEFAULT]} | _ENTRIES


def preset(name: str) -> TrainConfig:
    """The settings of a system. Raises `InvalidInput` for an unknown name."""
    return _entry(name).config


def system_of(schedule: Schedule, scene: SceneData) -> ImageSystem | RaySystem:
    """A new system for a run's settings."""
    name = schedule.config.run.system
    build = _entry(name).build if name else None
    if build is None:
        from msdgs_train.systems.gaussian_splatting import GaussianSplatting

        build = GaussianSplatting
    return build(schedule, scene)


def _entry(name: str) -> SystemEntry:
    known = systems()
    if name not in known:
        raise InvalidInput("preset", f"one of {', '.join(known)}; others come with --plugin MODULE", name)
    return known[name]

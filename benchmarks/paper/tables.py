"""The tables as TOML files: published numbers, and what is trained for each row."""

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.comparison.matrix import Budget, read_system
from msdgs_train.comparison.scenes import Scene, read_scenes
from msdgs_train.engine.config import TrainConfig
from msdgs_train.settings import optional
from msdgs_train.systems.registry import systems

FOLDER = Path(__file__).parent
MEAN = "mean"
NUM_LAYERS = "num_layers"


@dataclass(frozen=True)
class PaperBudget(Budget):
    """Settings that all systems share; None keeps the system's own."""

    steps: Annotated[int | None, optional("INT")] = None
    """Optimizer steps of each run, instead of the preset's. All schedules are fractions of a run and scale with it."""

    def of(self, config: TrainConfig) -> TrainConfig:
        return Budget.of(replace(self, steps=self.steps or config.run.steps), config)


@dataclass(frozen=True)
class Method:
    """A row of a table."""

    name: str
    """As the paper writes it."""
    system: str
    """What is trained, a table of systems.toml."""
    baseline: str = ""
    """The row over which the paper states its gain; empty: none."""
    parameters: Sequence[float] = ()
    """Published, millions: of the deformation, and of the modulation with its embeddings."""
    numbers: Mapping[str, Sequence[float]] = field(default_factory=dict)
    """Published, by scene and for the mean over scenes, in the order of the table's metrics; empty: none."""
    cause: str = "not tested"
    """Why ours differs by more than 1 dB, if that was tested."""


@dataclass(frozen=True)
class Table:
    """A table of the paper."""

    name: str
    title: str
    dataset: str
    metrics: Sequence[str]
    scenes: Mapping[str, Sequence[str]]
    """Names of each scene's folder, by the paper's name."""
    methods: Sequence[Method]


def read_table(name: str) -> Table:
    """Read a table of this folder."""
    contents = dict(_contents(name))
    methods = [Method(**method) for method in contents.pop("methods")]
    return Table(name, methods=methods, **contents)


def find_scenes(table: Table, sources: Sequence[Path]) -> list[Scene]:
    """The scenes of TOML files, of datasets, and of folders with the table's scenes in them, which have its names.

    Raises `InvalidInput` naming what is missing.
    """
    if not sources:
        raise InvalidInput("data", f"the folder of {table.dataset}, datasets or TOML files of scenes", "none")
    spelled = {_plain(alias): scene for scene, aliases in table.scenes.items() for alias in aliases}
    folders: list[Path] = []
    for source in sources:
        inside = sorted(source.iterdir()) if source.is_dir() else []
        folders += [folder for folder in inside if folder.is_dir() and _plain(folder.name) in spelled] or [source]
    return [replace(scene, name=spelled.get(_plain(scene.name), scene.name)) for scene in read_scenes(folders)]


def read_systems(table: Table, budget: Budget, *, small: bool) -> tuple[dict[str, tuple[str, TrainConfig]], list[str]]:
    """What is trained for each row, the name of a system and its settings; and the presets of other rows, which are not
    registered."""
    definitions, found, absent = _contents("systems"), {}, []
    for method in table.methods:
        name, settings = _definition(definitions, method.system, "small" if small else "published")
        if settings["preset"] in systems():
            found[method.name] = (f"{name} small" if small else name, _config(name, settings, budget))
        else:
            absent.append(f"{method.name} ({settings['preset']})")
    return found, absent


def _definition(definitions: Mapping[str, Any], name: str, variant: str) -> tuple[str, dict[str, Any]]:
    settings = definitions[name][variant]
    return _definition(definitions, settings, variant) if isinstance(settings, str) else (name, dict(settings))


def _config(name: str, settings: dict[str, Any], budget: Budget) -> TrainConfig:
    num_layers = settings.pop(NUM_LAYERS, None)
    config = read_system(name, settings, budget)
    return config if num_layers is None else config.updated(layers=config.model.layers[:1] * num_layers)


def _contents(name: str) -> Mapping[str, Any]:
    return tomllib.loads((FOLDER / f"{name}.toml").read_text(encoding="utf-8"))


def _plain(name: str) -> str:
    return "".join(filter(str.isalnum, name.lower()))

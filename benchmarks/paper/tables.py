"""The tables as TOML files: published numbers, and what is trained for each row."""

import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

from benchmarks.paper.recipes import Recipe, recipe, scene_recipes
from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.comparison.matrix import Budget, Run, make_runs, read_system
from msdgs_train.comparison.scenes import Scene, all_scenes
from msdgs_train.engine.config import TrainConfig
from msdgs_train.settings import optional

FOLDER = Path(__file__).parent
MEAN = "mean"
NUM_LAYERS = "num_layers"


@dataclass(frozen=True)
class PaperBudget(Budget):
    """Settings that all systems share; None keeps the system's own."""

    steps: Annotated[int | None, optional("INT")] = None
    """Optimizer steps of each run, instead of the preset's. All schedules are fractions of a run and scale with it."""

    def of(self, config: TrainConfig) -> TrainConfig:
        return Budget.of(replace(self, steps=config.run.steps if self.steps is None else self.steps), config)


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
    width: int | None = None
    """Of the images of its scenes, in pixels, which are downscaled to it."""
    notes: Sequence[str] = ()
    """How all rows differ from what is published."""


def read_table(name: str) -> Table:
    """Read a table of this folder."""
    contents = dict(_contents(name))
    methods = [Method(**method) for method in contents.pop("methods")]
    return Table(name, methods=methods, **contents)


def find_scenes(table: Table, sources: Sequence[Path]) -> list[Scene]:
    """The scenes of TOML files, of datasets, and of folders with the table's scenes in them, which have its names;
    their folders may be missing.

    Raises `InvalidInput` naming what is invalid.
    """
    if not sources:
        raise InvalidInput("data", f"the folder of {table.dataset}, datasets or TOML files of scenes", "none")
    spelled = {_plain(alias): scene for scene, aliases in table.scenes.items() for alias in aliases}
    folders: list[Path] = []
    for source in sources:
        inside = sorted(source.iterdir()) if source.is_dir() else []
        folders += [folder for folder in inside if folder.is_dir() and _plain(folder.name) in spelled] or [source]
    return [replace(scene, name=spelled.get(_plain(scene.name), scene.name)) for scene in all_scenes(folders)]


@dataclass(frozen=True)
class Trained:
    """What is trained for a row."""

    system: str
    """Its name in systems.toml."""
    configs: Mapping[str, TrainConfig]
    """By scene."""
    recipes: Mapping[str, Recipe]
    """What authors publish for the table's dataset, under an empty name, and what changes for scenes."""


def read_systems(table: Table, scenes: Sequence[Scene], budget: Budget, *, small: bool) -> dict[str, Trained]:
    """What is trained for each row on each scene."""
    definitions, published = _contents("systems"), {} if small else _contents("published")
    found = {}
    for method in table.methods:
        name, settings = _definition(definitions, method.system, "small" if small else "published")
        base = recipe(published, settings["preset"], table.dataset)
        changes = scene_recipes(published, settings["preset"], table.dataset)
        own = {scene.name: changes[key] for scene in scenes if (key := _scene_key(table, scene, changes))}
        config = _config(name, settings)
        sized = config.updated(size=table.width) if table.width else config
        configs = {
            scene.name: base.changed(own.get(scene.name, {})).applied(sized if scene.name in table.scenes else config)
            for scene in scenes
        }
        configs = {scene: budget.of(config) for scene, config in configs.items()}
        recipes = {"": base} | {scene: Recipe().changed(change) for scene, change in own.items()}
        found[method.name] = Trained(f"{name} small" if small else name, configs, recipes)
    return found


def runs_of(trained: Mapping[str, Trained], scenes: Sequence[Scene], seeds: Sequence[int], out: Path) -> list[Run]:
    """One run per system, scene and seed, ordered by seed."""
    runs = []
    for scene in scenes:
        configs = {row.system: row.configs[scene.name] for row in trained.values()}
        runs += make_runs(configs, [scene], seeds, out)
    return sorted(runs, key=lambda run: seeds.index(run.seed))


def _scene_key(table: Table, scene: Scene, known: Iterable[str]) -> str | None:
    """The name under which a scene, or its folder, is known."""
    names = {_plain(scene.name), _plain(scene.folder.name)}
    names |= {_plain(paper) for paper, aliases in table.scenes.items() if not names.isdisjoint(map(_plain, aliases))}
    return next((name for name in known if _plain(name) in names), None)


def _definition(definitions: Mapping[str, Any], name: str, variant: str) -> tuple[str, dict[str, Any]]:
    settings = definitions[name][variant]
    return _definition(definitions, settings, variant) if isinstance(settings, str) else (name, dict(settings))


def _config(name: str, settings: Mapping[str, Any]) -> TrainConfig:
    """The settings of systems.toml, before those of a dataset."""
    own = {key: value for key, value in settings.items() if key != NUM_LAYERS}
    config = read_system(name, own, PaperBudget())
    num_layers = settings.get(NUM_LAYERS)
    return config if num_layers is None else config.updated(layers=config.model.layers[:1] * num_layers)


def _contents(name: str) -> Mapping[str, Any]:
    return tomllib.loads((FOLDER / f"{name}.toml").read_text(encoding="utf-8"))


def _plain(name: str) -> str:
    return "".join(filter(str.isalnum, name.lower()))

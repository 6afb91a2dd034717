"""The runs of a comparison: systems × scenes × seeds, each with its settings and its folder."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.comparison.scenes import SPLITS, Scene
from msdgs_train.comparison.tables import read_tables, require_unique
from msdgs_train.engine.config import TrainConfig, differences
from msdgs_train.gaussians.config import ModelConfig
from msdgs_train.layers.parts import to_text
from msdgs_train.settings import optional
from msdgs_train.systems.registry import DEFAULT, preset, systems
from msdgs_train.systems.unused import refuse_unused

EVALUATIONS = 10  # number of evaluations of held-out images during training
LOG_LINES = 100
DEFAULT_STEPS = 3000
SHARED = {
    **{name: f"--{name} sets it for all systems" for name in ("minutes", "threads", "time", "device")},
    "seed": "--seeds sets it for all systems",
    **dict.fromkeys(("eval_every", "checkpoint_every", "log_every"), "it is a fraction of the run, for all systems"),
}
"""Settings that are not a system's own, and why."""


@dataclass(frozen=True)
class Budget:
    """Settings that all systems share; None keeps the system's own."""

    steps: Annotated[int | None, optional("INT")] = None
    """Optimizer steps of each run, instead of the preset's; 3,000 without --minutes. All schedules are fractions of a
    run and scale with it."""
    minutes: Annotated[float | None, optional("MINUTES")] = None
    """Length of each run, counted as --time says; --steps or the preset's steps are then those of its schedule."""
    size: Annotated[int | None, optional("PIXELS")] = None
    """Width of all images in pixels, except of scenes that have their own."""
    time_from: Annotated[str | None, optional("{names,index,none,REGEX}")] = None
    """Where the times of all images come from, as in `fit`, except of scenes that have their own."""
    init_num_pts: Annotated[int | None, optional("INT")] = None
    """Initial Gaussians of all systems; their own settings if not given."""
    max_gaussians: Annotated[int | None, optional("INT")] = None
    """Maximum Gaussians of all systems; their own settings if not given."""
    device: Literal["cpu", "cuda"] = "cpu"
    """As in `fit`."""
    threads: int = 1
    """CPU threads of each run."""
    time: Literal["wall", "cpu"] = "wall"
    """What --minutes counts: time that passes, or CPU time of all threads of a run."""

    def of(self, config: TrainConfig) -> TrainConfig:
        """Return the settings of a system under this budget."""
        steps = DEFAULT_STEPS if self.steps is None and self.minutes is None else self.steps
        shared = {name: getattr(self, name) for name in ("size", "time_from", "init_num_pts", "max_gaussians")}
        given = {name: value for name, value in {"steps": steps, **shared}.items() if value is not None}
        config = config.updated(minutes=self.minutes, threads=self.threads, time=self.time, device=self.device, **given)
        every = max(config.run.steps // EVALUATIONS, 1)
        logged = max(config.run.steps // LOG_LINES, 1)
        return config.updated(eval_every=every, checkpoint_every=every, log_every=logged)


@dataclass(frozen=True)
class Run:
    """One cell of the matrix."""

    system: str
    scene: str
    seed: int
    data: Path
    folder: Path
    config: TrainConfig
    settings: str
    """Eight digits that change with any setting of the system, the scene and the command besides the budget's time and
    threads. Settings at their defaults don't count, so that new settings leave them as they are."""
    splits: tuple[str, ...] = SPLITS
    """Held-out images whose metrics are reported."""

    @property
    def name(self) -> str:
        return f"{self.system}, {self.scene}, seed {self.seed}"


def read_systems(sources: Sequence[str], budget: Budget) -> dict[str, TrainConfig]:
    """Read the settings of systems from names of presets and from TOML files, each table of which is a system: a
    `preset` and changed settings.

    Raises `InvalidInput` naming the file, the system and the invalid setting.
    """
    tables = [pair for source in sources for pair in _tables(source)]
    configs = [(name, read_system(name, table, budget)) for name, table in tables]
    require_unique("system", (name for name, _ in configs))
    return dict(configs)


def make_runs(
    systems: Mapping[str, TrainConfig], scenes: Sequence[Scene], seeds: Sequence[int], out: Path
) -> list[Run]:
    """Return one run per system, scene and seed, ordered by seed: if the comparison is stopped early, it has results of
    every system."""
    require_unique("seed", map(str, seeds))
    return [
        Run(name, scene.name, seed, scene.folder, out / name / f"{scene.name}_{seed}",
            config.updated(seed=seed, **scene.settings), _digest(config, scene), scene.splits)
        for seed in seeds
        for scene in scenes
        for name, config in systems.items()
    ]  # fmt: skip


def _digest(config: TrainConfig, scene: Scene) -> str:
    values = [_changed(config.updated(seed=0, minutes=None, time="wall")), dict(scene.settings), scene.splits]
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:8]


def _changed(config: TrainConfig) -> dict[str, Any]:
    """By group, the settings besides threads that differ from those of msdgs-small, or of the defaults of the model and
    of the system."""
    own = type(config.own)()
    default, changed = preset("msdgs-small").updated(model=ModelConfig(), own=own).to_dict(), config.to_dict()
    del changed["run"]["threads"]
    for group, values in changed.items():
        changed[group] = {n: v for n, v in values.items() if n not in default[group] or v != default[group][n]}
    parts = {"support": to_text(config.model.support), "layers": [to_text(layer) for layer in config.model.layers]}
    return changed | {"model": changed["model"] | parts}


def _tables(source: str) -> list[tuple[str, Mapping[str, Any]]]:
    if source in systems():
        return [(source, {"preset": source})]
    path = Path(source)
    if path.suffix != ".toml":
        raise InvalidInput("config", f"a preset ({', '.join(systems())}) or a .toml file", source)
    return list(read_tables("config", path).items())


def read_system(name: str, table: Mapping[str, Any], budget: Budget) -> TrainConfig:
    """The settings of a system: a `preset` and others that replace its own, under a budget.

    Raises `InvalidInput` naming the system and the invalid setting.
    """
    changes = {key: value for key, value in table.items() if key != "preset"}
    try:
        start = preset(table.get("preset", DEFAULT))
        own = start.updated(**changes)
        refuse_unused(start, own)
        shared = budget.of(own)
        replaced = {key for key, *_ in differences(own, shared)}
        for key, value in changes.items():
            if key in SHARED or key in replaced:
                why = SHARED.get(key, f"--{key.replace('_', '-')} sets it for all systems")
                raise InvalidInput(f"config.{key}", f"not given: {why}", value)
        return shared
    except (InvalidInput, TypeError, ValueError) as error:
        raise InvalidInput("config", "made of valid settings", f"system `{name}`: {error}") from error

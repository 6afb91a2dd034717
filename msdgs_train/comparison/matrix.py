"""The runs of a comparison: systems × scenes × seeds, each with its settings and its folder."""

import re
import tomllib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.engine.config import TrainConfig
from msdgs_train.settings import optional
from msdgs_train.systems.registry import DEFAULT, preset, systems

EVALUATIONS = 10  # number of evaluations of held-out images during training
LOG_LINES = 100


@dataclass(frozen=True)
class Budget:
    """Settings that all systems share; None keeps the system's own."""

    steps: Annotated[int | None, optional("INT")] = 3000
    """Optimizer steps of each run, instead of the preset's. All schedules are fractions of a run and scale with it."""
    minutes: Annotated[float | None, optional("MINUTES")] = None
    """Length of each run, counted as --time says, instead of --steps."""
    size: Annotated[int | None, optional("PIXELS")] = None
    """Width of all images in pixels, height in proportion; their own if not given."""
    time_from: Annotated[str | None, optional("{names,index,none,REGEX}")] = None
    """Times of all images, as in `msdgs-train fit --help`; the datasets' own if not given."""
    init_num_pts: Annotated[int | None, optional("INT")] = None
    """Initial Gaussians of all systems; their own settings if not given."""
    max_gaussians: Annotated[int | None, optional("INT")] = None
    """Maximum Gaussians of all systems; their own settings if not given."""
    threads: int = 1
    """CPU threads of each run."""
    time: Literal["wall", "cpu"] = "wall"
    """What --minutes counts: time that passes, or CPU time of all threads of a run."""

    def settings(self) -> dict[str, Any]:
        """Return the settings of `TrainConfig`."""
        given = {"minutes": self.minutes, "threads": self.threads, "time": self.time, "eval_every": 0}
        if self.steps is not None:
            every = max(self.steps // EVALUATIONS, 1)
            given |= {"eval_every": every, "checkpoint_every": every, "log_every": max(self.steps // LOG_LINES, 1)}
        shared = {name: getattr(self, name) for name in ("steps", "size", "time_from", "init_num_pts", "max_gaussians")}
        return given | {name: value for name, value in shared.items() if value is not None}


@dataclass(frozen=True)
class Run:
    """One cell of the matrix."""

    system: str
    scene: str
    seed: int
    data: Path
    folder: Path
    config: TrainConfig

    @property
    def name(self) -> str:
        return f"{self.system}, {self.scene}, seed {self.seed}"


def read_systems(sources: Sequence[str], budget: Budget) -> dict[str, TrainConfig]:
    """Read the settings of systems from names of presets and from TOML files, each table of which is a system: a
    `preset` and changed settings.

    Raises `InvalidInput` naming the file, the system and the invalid setting.
    """
    tables = [pair for source in sources for pair in _tables(source)]
    configs = [(name, _config(name, table, budget)) for name, table in tables]
    require_unique("system", (name for name, _ in configs))
    return dict(configs)


def make_runs(systems: Mapping[str, TrainConfig], scenes: Sequence[Path], seeds: Sequence[int], out: Path) -> list[Run]:
    """Return one run per system, scene and seed, ordered by seed: if the comparison is stopped early, it has results of
    every system."""
    require_unique("scene", (scene.resolve().name for scene in scenes))
    require_unique("seed", map(str, seeds))
    return [
        Run(name, data.name, seed, data, out / name / f"{data.name}_{seed}", config.updated(seed=seed))
        for seed in seeds
        for data in map(Path.resolve, scenes)
        for name, config in systems.items()
    ]


def _tables(source: str) -> list[tuple[str, Mapping[str, Any]]]:
    if source in systems():
        return [(source, {"preset": source})]
    path = Path(source)
    if path.suffix != ".toml":
        raise InvalidInput("config", f"a preset ({', '.join(systems())}) or a .toml file", source)
    try:
        contents = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InvalidInput("config", "a readable file", f"{path}: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InvalidInput("config", "a TOML file", f"{path}: {error}") from error
    for name, table in contents.items():
        if not isinstance(table, dict) or not re.fullmatch(r"\w[\w .+=-]*", name):
            raise InvalidInput("config", "tables named with letters, digits, spaces and .+=-", f"{path}: `{name}`")
    return list(contents.items())


def _config(name: str, table: Mapping[str, Any], budget: Budget) -> TrainConfig:
    changes = {key: value for key, value in table.items() if key != "preset"}
    try:
        return preset(table.get("preset", DEFAULT)).updated(**changes | budget.settings())
    except (InvalidInput, TypeError, ValueError) as error:
        raise InvalidInput("config", "made of valid settings", f"system `{name}`: {error}") from error


def require_unique(kind: str, given: Iterable[str]) -> None:
    """Raise `InvalidInput` if no name is given, or one twice."""
    names = list(given)
    if not names:
        raise InvalidInput(kind, "given, one or more", "none")
    name, count = Counter(names).most_common(1)[0]
    if count > 1:
        raise InvalidInput(kind, "named once", f"`{name}` twice")

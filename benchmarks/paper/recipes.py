"""What authors publish for a dataset and its scenes, as published.toml has it."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from msdgs_train.engine.config import TrainConfig

PHASES = ("static_fraction", "sh_degree_fraction", "refine_start_fraction", "refine_stop_fraction")
PHASES += ("refine_every_fraction", "reset_every_fraction")


@dataclass(frozen=True)
class Recipe:
    """Settings in place of those of a preset."""

    source: str = ""
    """Where they come from."""
    steps: int | None = None
    """Of a run; None: as many as the preset has."""
    in_steps: Mapping[str, int] = field(default_factory=dict)
    """Fractions of a run, in steps; others of `PHASES` keep the preset's steps."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Others of the run."""
    layer: Mapping[str, Any] = field(default_factory=dict)
    """Of all layers."""
    differs: Sequence[str] = ()
    """What of it isn't here."""

    def changed(self, other: Mapping[str, Any]) -> "Recipe":
        """This with what another entry of published.toml replaces or adds."""
        merged = {
            name: {**getattr(self, name), **value} if isinstance(value, dict) else value
            for name, value in other.items()
        }
        if "differs" in other:
            merged["differs"] = [*self.differs, *other["differs"]]
        return dataclasses.replace(self, **merged)

    def applied(self, config: TrainConfig) -> TrainConfig:
        """The settings of a run."""
        steps, kept = self.steps or config.run.steps, {}
        if steps != config.run.steps:
            own = {name: value for group in config.to_dict().values() for name, value in group.items()}
            kept = {name: round(own[name] * config.run.steps) / steps for name in PHASES}
        fractions = {name: count / steps for name, count in self.in_steps.items()}
        layers = [dataclasses.replace(layer, **self.layer) for layer in config.model.layers]
        return config.updated(steps=steps, layers=layers, **{**kept, **self.settings, **fractions})

    def __str__(self) -> str:
        steps = [] if self.steps is None else [f"{self.steps:,} steps"]
        fractions = [f"{name} {count:,} steps" for name, count in self.in_steps.items()]
        settings = [f"{name} {value}" for name, value in {**self.settings, **self.layer}.items()]
        return ", ".join([*steps, *fractions, *settings])


def recipe(published: Mapping[str, Any], preset: str, dataset: str) -> Recipe:
    """That of a preset for a dataset; an empty one if published.toml has none."""
    entry = dict(published.get(preset, {}).get(dataset, {}))
    base = recipe(published, *entry.pop("like")) if "like" in entry else Recipe()
    entry.pop("scenes", None)
    return base.changed(entry)


def scene_recipes(published: Mapping[str, Any], preset: str, dataset: str) -> Mapping[str, Mapping[str, Any]]:
    """What changes for scenes, by their names."""
    return published.get(preset, {}).get(dataset, {}).get("scenes", {})

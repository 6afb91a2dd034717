"""The interface of plans, and the names of plans with a size."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import onnx

from msdgs_export.bake import Baked

if TYPE_CHECKING:
    from msdgs_export.trajectories.sampling import Trajectories

BASELINE = "network"
"""The plan that computes the model itself in float32; all others are compared with it."""


@dataclass(frozen=True)
class PlanSpec:
    """The parsed name of a plan: `prefix:2` is ("prefix", 2)."""

    name: str
    count: int | None = None

    def __str__(self) -> str:
        return self.name if self.count is None else f"{self.name}:{self.count}"


@dataclass(frozen=True)
class Plan:
    """One way to compute a deformation in a graph. Register it in `PLANS` of `registry.py` under its name."""

    name: str
    usage: str
    """Its name with a size, and an explanation, for messages."""
    color: str
    """Color of its points in the figure of a report."""
    build: Callable[[Baked, PlanSpec, Callable[[], Trajectories]], onnx.ModelProto]
    """The scene file of a baked scene in which something moves. The last argument samples its trajectories."""
    candidates: Callable[[int], Sequence[str]] = lambda layers: ()
    """The names that a sweep tries, given the number of the model's layers."""
    counts: range | None = None
    """Allowed counts; None: it has no size."""
    counts_layers: bool = False
    """Whether its size is a number of layers as trained, none of which pruning may then remove."""
    fitted: bool = False
    """Whether it is fitted to float64 trajectories; others run layers for each frame."""

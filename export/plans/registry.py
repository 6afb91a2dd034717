"""From the text of a plan to the scene file that follows it."""

import re
from collections.abc import Callable
from dataclasses import dataclass

import onnx

from export.jobs.bake import Baked
from export.plans.int8 import int8
from export.plans.keyframes import keyframes
from export.plans.lowrank import RANKS, lowrank
from export.plans.network import network, prefix
from export.plans.scene_graph import still
from export.plans.size import Size
from export.trajectories.adaptive import COUNTS
from export.trajectories.sampling import Trajectories, trajectories_of
from export.trajectories.splines import FEWEST
from msdgs_serve.scene.errors import InvalidInput

PIXELS = 0.1
"""What a fitted plan without a size may be off."""


@dataclass(frozen=True)
class Plan:
    """A plan as its text names it: `prefix:2` is ("prefix", 2), `lowrank:0.05` ("lowrank", None, 0.05)."""

    name: str
    count: int | None = None
    pixels: float | None = None

    def __str__(self) -> str:
        size = self.count if self.pixels is None else self.pixels
        return self.name if size is None else f"{self.name}:{size}"

    @property
    def fitted(self) -> bool:
        """Whether it is fitted to trajectories."""
        return self.name in _FITTED


@dataclass(frozen=True)
class _Range:
    least: int
    most: int
    fit: Callable[[Baked, Trajectories, Size], onnx.ModelProto]


_FITTED = {
    "lowrank": _Range(1, RANKS[-1], lowrank),
    "keyframes": _Range(FEWEST, COUNTS[-1], keyframes),
}
_MOST_LAYERS = 1_000

POSSIBLE = "; ".join(
    [
        "network",
        "prefix:k, the first k layers",
        "int8",
        f"lowrank:r, r functions of time, {_FITTED['lowrank'].least} to {_FITTED['lowrank'].most}",
        f"keyframes:n, n poses, {_FITTED['keyframes'].least} to {_FITTED['keyframes'].most}",
        "lowrank:e or keyframes:e, as large as an error of e pixels needs, as in lowrank:0.05",
        f"lowrank or keyframes, the same with e = {PIXELS}",
    ]
)
"""All plans in words, for messages and help."""


def parse(text: str | Plan) -> Plan:
    """The plan that a text names. Raises `InvalidInput` for any other text, saying which there are."""
    match = re.fullmatch(r"([a-z0-9]+)(?::(?:([0-9]{1,9})|([0-9]{1,9}\.[0-9]{1,9})))?", str(text), re.ASCII)
    if match:
        name = match[1]
        plan = Plan(name, int(match[2]) if match[2] else None, float(match[3]) if match[3] else None)
        if _exists(plan):
            return plan
    raise InvalidInput("plan", f"one of: {POSSIBLE}", repr(str(text)))


def _exists(plan: Plan) -> bool:
    if plan.name in _FITTED:
        size = _FITTED[plan.name]
        return plan.pixels != 0 and (plan.count is None or size.least <= plan.count <= size.most)
    if plan.name == "prefix":
        return plan.count is not None and 1 <= plan.count <= _MOST_LAYERS
    return plan.name in ("network", "int8") and plan.count is None and plan.pixels is None


def build(plan: str | Plan, baked: Baked, trajectories: Trajectories | None = None) -> onnx.ModelProto:
    """The scene file of a plan. A scene in which nothing moves has no nodes under any.

    Fitted plans take the scene's `trajectories`; left out, they are sampled, once for all plans of a scene.
    What a fitted plan knows of its own errors is `measured_error` in the result, until the file itself is measured.
    Raises `InvalidInput` for a plan that doesn't exist or that this scene can't have.
    """
    plan = parse(plan)
    if not len(baked.moving):
        return still(baked, str(plan))
    if plan.name in _FITTED:
        pixels = PIXELS if plan.count is None and plan.pixels is None else plan.pixels
        size = Size(str(plan), plan.count, pixels)
        return _FITTED[plan.name].fit(baked, trajectories or trajectories_of(baked), size)
    if plan.name == "prefix":
        return prefix(baked, plan.count or 0)
    return int8(baked) if plan.name == "int8" else network(baked)

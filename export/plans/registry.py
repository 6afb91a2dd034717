"""From the text of a plan to the scene file that follows it."""

import re
from collections.abc import Callable
from dataclasses import dataclass

import onnx

from export.bake import Baked
from export.plans.network import network
from export.plans.prefix import prefix
from export.plans.scene_graph import still
from msdgs_serve.scene.errors import InvalidInput

MOST = 9_999
"""Of the number in a plan: more is a slip of the hand."""


@dataclass(frozen=True)
class Plan:
    """A plan as its text names it: `prefix:2` is ("prefix", 2)."""

    name: str
    number: int | None = None

    def __str__(self) -> str:
        return self.name if self.number is None else f"{self.name}:{self.number}"


@dataclass(frozen=True)
class _Kind:
    least: int | None  # the smallest number that it takes; None: it takes none
    build: Callable[[Baked, int], onnx.ModelProto]


_KINDS = {
    "network": _Kind(None, lambda baked, _: network(baked)),
    "prefix": _Kind(1, prefix),
}


def parse(text: str) -> Plan:
    """The plan that a text names. Raises `InvalidInput` for any other text, saying which there are."""
    match = re.fullmatch(r"([a-z0-9]+)(?::([0-9]{1,4}))?", text) if isinstance(text, str) else None
    kind = _KINDS.get(match[1]) if match else None
    if match and kind:
        number = None if match[2] is None else int(match[2])
        fits = number is None if kind.least is None else number is not None and number >= kind.least
        if fits:
            return Plan(match[1], number)
    raise InvalidInput("plan", f"one of {possible()}", repr(text))


def possible() -> str:
    """All plans in words, for messages and help."""
    return ", ".join(
        name if kind.least is None else f"{name}:n with n from {kind.least} to {MOST}" for name, kind in _KINDS.items()
    )


def build(plan: str | Plan, baked: Baked) -> onnx.ModelProto:
    """The scene file of a plan, without measured errors. A scene in which nothing moves has no nodes under any.

    Raises `InvalidInput` for a plan that doesn't exist or that this scene can't have.
    """
    plan = parse(str(plan))
    if not len(baked.moving):
        return still(baked, str(plan))
    return _KINDS[plan.name].build(baked, plan.number or 0)

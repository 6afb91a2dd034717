"""The plans by name, and the scene file of a plan."""

import re
from collections.abc import Collection

import onnx

from msdgs_export.bake import Baked
from msdgs_export.plans.base import Plan, PlanSpec
from msdgs_export.plans.compact import COMPACT
from msdgs_export.plans.network import NETWORK, PREFIX
from msdgs_export.plans.scene_graph import static_graph
from msdgs_export.trajectories.sampling import Trajectories
from msdgs_serve.scene.errors import InvalidInput

PLANS: dict[str, Plan] = {plan.name: plan for plan in (NETWORK, PREFIX, COMPACT)}
"""By name. `PLANS[plan.name] = plan` adds a plan from outside this package; a sweep then tries its candidates too."""


def usage() -> str:
    """An explanation of all plans, for messages."""
    return "; ".join(plan.usage for plan in PLANS.values())


def parse(text: str | PlanSpec) -> PlanSpec:
    """Parse the name of a plan. Raises `InvalidInput` for any other text, listing the plans."""
    match = re.fullmatch(r"([a-z0-9]+)(?::([0-9]{1,9}))?", str(text), re.ASCII)
    if match:
        spec = PlanSpec(match[1], int(match[2]) if match[2] else None)
        if _exists(spec):
            return spec
    raise InvalidInput("plan", f"one of: {usage()}", repr(str(text)))


def plan_of(text: str | PlanSpec) -> Plan:
    """The plan with this name. Raises `InvalidInput` as `parse` does."""
    return PLANS[parse(text).name]


def check_appearance(plan: str | PlanSpec, changing: Collection[str]) -> None:
    """Raise `InvalidInput` for a plan that can't hold opacities or SH which are `changing`."""
    if changing and plan_of(plan).fitted:
        layered = ", ".join(each.name for each in PLANS.values() if not each.fitted)
        changes = f"this model's {' and '.join(changing)} change with time"
        raise InvalidInput("plan", f"one that runs layers ({layered}), since {changes}", str(plan))


def _exists(spec: PlanSpec) -> bool:
    plan = PLANS.get(spec.name)
    if plan is None:
        return False
    return plan.counts is None if spec.count is None else plan.counts is not None and spec.count in plan.counts


def build(plan: str | PlanSpec, baked: Baked, trajectories: Trajectories | None = None) -> onnx.ModelProto:
    """The scene file of a plan. If nothing moves, its graph has no nodes.

    Fitted plans use the scene's `trajectories`; by default they are sampled. Raises `InvalidInput` for a plan that
    doesn't exist or isn't possible for this scene.
    """
    spec, layers = parse(plan), max(len(baked.layers), 1)  # any plan is possible for a scene without layers
    if PLANS[spec.name].counts_layers and (spec.count or 0) > layers:
        raise InvalidInput("plan", f"{spec.name}:k with k from 1 to {layers}, this model's layers", spec.count)
    if not len(baked.moving):
        return static_graph(baked, str(spec))
    check_appearance(spec, baked.scene.changing)
    return PLANS[spec.name].build(baked, spec, lambda: trajectories or Trajectories(baked))

"""The plans by name, and the scene file of a plan."""

import re
from collections.abc import Collection

import onnx

from export.jobs.bake import Baked
from export.plans.base import DEFAULT_PIXELS, Plan, PlanSpec
from export.plans.int8 import INT8
from export.plans.keyframes import KEYFRAMES
from export.plans.lowrank import LOWRANK
from export.plans.network import NETWORK, PREFIX
from export.plans.scene_graph import static_graph
from export.trajectories.sampling import Trajectories
from msdgs_serve.scene.errors import InvalidInput

PLANS: dict[str, Plan] = {plan.name: plan for plan in (NETWORK, PREFIX, INT8, LOWRANK, KEYFRAMES)}
"""By name. `PLANS[plan.name] = plan` adds a plan from outside this package; a sweep then tries its candidates too."""


def usage() -> str:
    """An explanation of all plans, for messages."""
    fitted = [plan.name for plan in PLANS.values() if plan.fitted]
    bounded = " or ".join(f"{name}:e" for name in fitted)
    return "; ".join(
        [
            *(plan.usage for plan in PLANS.values()),
            f"{bounded}, as large as an error of e pixels needs, as in {fitted[0]}:0.05",
            f"{' or '.join(fitted)}, the same with e = {DEFAULT_PIXELS}",
        ]
    )


def parse(text: str | PlanSpec) -> PlanSpec:
    """Parse the name of a plan. Raises `InvalidInput` for any other text, listing the plans."""
    match = re.fullmatch(r"([a-z0-9]+)(?::(?:([0-9]{1,9})|([0-9]{1,9}\.[0-9]{1,9})))?", str(text), re.ASCII)
    if match:
        spec = PlanSpec(match[1], int(match[2]) if match[2] else None, float(match[3]) if match[3] else None)
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
    if spec.count is not None:
        return plan.counts is not None and spec.count in plan.counts
    return spec.pixels != 0 if plan.fitted else spec.pixels is None and plan.counts is None


def build(plan: str | PlanSpec, baked: Baked, trajectories: Trajectories | None = None) -> onnx.ModelProto:
    """The scene file of a plan. If nothing moves, its graph has no nodes.

    Fitted plans use the scene's `trajectories`; by default they are sampled. The error bound of a fitted plan is stored
    as `measured_error` until the file itself is measured. Raises `InvalidInput` for a plan that doesn't exist or isn't
    possible for this scene.
    """
    spec = parse(plan)
    if not len(baked.moving):
        return static_graph(baked, str(spec))
    check_appearance(spec, baked.scene.changing)
    return PLANS[spec.name].build(baked, spec, lambda: trajectories or Trajectories(baked))

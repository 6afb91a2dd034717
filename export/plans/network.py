"""Plans `network`, all layers in float32 as the model computes them, and `prefix:k`, the first k of them."""

from dataclasses import replace

import numpy as np
import onnx

from export.jobs.bake import Baked
from export.layers.graph import GraphBuilder
from export.plans.base import Plan
from export.plans.scene_graph import finished, new_graph, unit_quats
from export.supports import SupportInputs, support_export_of
from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.gaussians.scale_space import LOG_SCALE_LIMIT, MIN_SCALE


def network(baked: Baked, plan: str = "network") -> onnx.ModelProto:
    """The scene with all its layers, exactly as trained."""
    graph = new_graph(baked)
    _deform(graph, baked)
    return finished(graph, baked, plan)


def _deform(graph: GraphBuilder, baked: Baked) -> None:
    """Canonical values of the ids, moved by the chain on its support, then activated: `DynamicGaussians.pose`."""
    moving = baked.moving
    means = graph.node("Gather", [graph.constant("canonical_means", moving.means), "ids"], "ids.means")
    log_scales = graph.node(
        "Gather", [graph.constant("canonical_log_scales", moving.log_scales), "ids"], "ids.log_scales"
    )
    quats = graph.node("Gather", [graph.constant("canonical_quats", moving.quats), "ids"], "ids.quats")
    time = graph.node("Reshape", ["t", graph.constant("time_shape", np.array([1, 1], np.int64))], "time")

    steps = graph.constant("steps", np.array([len(baked.layers)], np.float32))
    inputs = SupportInputs(baked.support, baked.layers, means, quats, time, steps, moving.baked_attributes)
    parts = support_export_of(baked.support).deltas(graph, inputs)
    parts = {part: _modulated(graph, part, moving.modulation.get(part), value) for part, value in parts.items()}
    graph.node(*(("Add", [means, parts["means"]]) if "means" in parts else ("Identity", [means])), "means")
    _scales(graph, log_scales, parts.get("scales"), baked.scene.metadata.delta_space)
    unit_quats(graph, graph.node("Add", [quats, parts["quats"]], "raw_quats") if "quats" in parts else quats)


def _modulated(graph: GraphBuilder, part: str, factors: np.ndarray | None, deltas: str) -> str:
    """The summed deltas times the factors of the ids, if there are any (equation 12)."""
    if factors is None:
        return deltas
    name = f"{part.removesuffix('s')}_modulation"
    rows = graph.node("Gather", [graph.constant(name, factors), "ids"], f"ids.{name}")
    return graph.node("Mul", [rows, deltas], f"{name}.applied")


def _scales(graph: GraphBuilder, log_scales: str, deltas: str | None, delta_space: str) -> None:
    """The output `scales`: deltas, if there are any, are added before or after the exponential."""
    limits = [
        graph.constant(f"log_scales.{name}", np.array(limit, np.float32))
        for name, limit in (("min", -LOG_SCALE_LIMIT), ("max", LOG_SCALE_LIMIT))
    ]
    if deltas is None:
        graph.node("Exp", [graph.node("Clip", [log_scales, *limits], "log_scales.bounded")], "scales")
    elif delta_space == "raw":
        log_scales = graph.node("Add", [log_scales, deltas], "log_scales")
        graph.node("Exp", [graph.node("Clip", [log_scales, *limits], "log_scales.bounded")], "scales")
    else:
        canonical = graph.node("Exp", [graph.node("Clip", [log_scales, *limits], "log_scales.bounded")], "ids.scales")
        least = graph.constant("scales.min", np.array(MIN_SCALE, np.float32))
        graph.node("Max", [graph.node("Add", [canonical, deltas], "scales.moved"), least], "scales")


def prefix(baked: Baked, count: int) -> onnx.ModelProto:
    """The scene with its first `count` layers as trained. Raises `InvalidInput` if it has fewer."""
    if count > len(baked.layers):
        raise InvalidInput("plan", f"prefix:k with k from 1 to {len(baked.layers)}, this model's layers", count)
    metadata = replace(baked.scene.metadata, layers=baked.scene.metadata.layers[:count])
    scene = replace(baked.scene, metadata=metadata)
    return network(replace(baked, layers=baked.layers[:count], scene=scene), f"prefix:{count}")


NETWORK = Plan("network", "network", "#4269d0", lambda baked, spec, sample: network(baked))
PREFIX = Plan(
    "prefix",
    "prefix:k, the first k layers",
    "#6cc5b0",
    lambda baked, spec, sample: prefix(baked, spec.count or 0),
    candidates=lambda layers: [f"prefix:{k}" for k in range(1, layers)],
    counts=range(1, 1_001),
)

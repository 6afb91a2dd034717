"""Plans `network`, all layers in float32 as the model computes them, and `prefix:k`, the first k of them."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import onnx
from onnx import TensorProto

from msdgs_export.bake import Baked
from msdgs_export.layers.base import heads_of
from msdgs_export.layers.graph import GraphBuilder
from msdgs_export.plans.base import Plan
from msdgs_export.plans.ellipsoids import ellipsoids
from msdgs_export.plans.scene_graph import changing_output, finished, new_graph, unit_quats
from msdgs_export.supports import Layout, SupportInputs, support_export_of
from msdgs_serve.scene.baked import MOVING_OUTPUTS
from msdgs_serve.scene.spherical_harmonics import SH_C0
from msdgs_train.gaussians.scale_space import LOG_SCALE_LIMIT, MIN_SCALE


def network(baked: Baked, plan: str = "network") -> onnx.ModelProto:
    """The scene with all its layers, exactly as trained."""
    layout = support_export_of(baked.support).layout(baked.moving.means, baked.moving.baked_attributes)
    graph = new_graph(baked) if layout is None else GraphBuilder()
    _deform(graph, baked, layout)
    return finished(graph, baked, plan)


def _deform(graph: GraphBuilder, baked: Baked, layout: Layout | None) -> None:
    """Canonical values of the rows, moved by the chain on its support, then activated: `DynamicGaussians.pose`."""
    moving, export = baked.moving, support_export_of(baked.support)
    rows = _Rows(graph, len(moving), layout)
    means = rows.of("canonical_means", moving.means)
    log_scales = rows.of("canonical_log_scales", moving.log_scales)
    quats = rows.of("canonical_quats", moving.quats)
    time = graph.node("Reshape", ["t", graph.constant("time_shape", np.array([1, 1], np.int64))], "time")

    steps = graph.constant("steps", np.array([len(baked.layers)], np.float32))
    attributes = moving.baked_attributes if rows.layout is None else rows.layout.attributes
    constants = export.constants(baked.layers, moving.means).items()
    constants = {name: rows.of(name, values) for name, values in constants}
    inputs = SupportInputs(baked.support, baked.layers, means, quats, time, steps, attributes, constants)
    plain = not moving.modulation and baked.scene.metadata.delta_space == "raw"
    parts: dict[str, str] = {}
    poses = export.poses(graph, inputs, log_scales) if plain else None
    if poses is None:
        parts = export.deltas(graph, inputs)
        parts = {part: _modulated(graph, rows, part, moving.modulation.get(part), v) for part, v in parts.items()}
        poses = {name: rows.output(name) for name in MOVING_OUTPUTS}
        operator = ("Add", [means, parts["means"]]) if "means" in parts else ("Identity", [means])
        graph.node(*operator, poses["means"])
        is_raw = baked.quat_space == "raw" and "quats" in parts
        scales = "raw_scales" if is_raw else poses["scales"]
        _scales(graph, log_scales, parts.get("scales"), baked.scene.metadata.delta_space, scales)
        raw_quats = graph.node("Add", [quats, parts["quats"]], "raw_quats") if "quats" in parts else quats
        if is_raw:
            raw_quats = ellipsoids(graph, raw_quats, scales, poses["scales"])
        unit_quats(graph, raw_quats, poses["quats"])
    gains = poses.pop("gains", None) or parts.get("gains")
    shown: dict[str, str] = {}
    for name, values in moving.appearance.items():
        deltas = parts.get(name)
        if deltas and name == "sh" and heads_of(baked.layers[0]).sh > values.shape[1]:  # bands were pruned
            columns = graph.constant("sh.columns", np.arange(values[0].size))
            deltas = graph.node("Gather", [deltas, columns], "sh.deltas", axis=1)
        shown[f"{name}.shown"] = _appearance(graph, rows, name, values, deltas, gains)
    ordered = rows.in_order(poses | shown)
    for name in moving.appearance:
        changing_output(graph, baked.scene, name, ordered[f"{name}.shown"])


class _Rows:
    """The Gaussians that a graph poses: those asked for, or all in the order of a layout, which it undoes."""

    def __init__(self, graph: GraphBuilder, count: int, layout: Layout | None) -> None:
        self.layout, self._graph, self._count = layout, graph, count

    def of(self, name: str, values: np.ndarray) -> str:
        """Values stored per moving Gaussian, [M, ·], as values of the rows."""
        if self.layout is None:
            return self._graph.node("Gather", [self._graph.constant(name, values), "ids"], f"ids.{name}")
        return self._graph.constant(name, values[self.layout.rows])

    def output(self, name: str) -> str:
        """The name of an output in the order of the rows."""
        return name if self.layout is None else f"rows.{name}"

    def in_order(self, values: Mapping[str, str]) -> dict[str, str]:
        """Add the nodes that take each Gaussian once, in order, from values of a layout's rows; the results, by the
        same names, have these names."""
        if self.layout is None:
            return dict(values)
        graph, row_of_id = self._graph, np.zeros(self._count, np.int32)
        row_of_id[self.layout.rows[::-1]] = np.arange(len(self.layout.rows))[::-1]
        padding = len(self.layout.rows) - self._count
        if np.array_equal(row_of_id, np.arange(self._count)):
            for name, value in values.items():
                graph.split(value, [name, f"{name}.padding"], [self._count, padding], axis=0)
        else:
            ids = graph.node("Cast", [graph.constant("row_of_id", row_of_id)], "rows.of_id", to=TensorProto.INT64)
            for name, value in values.items():
                graph.node("Gather", [value, ids], name)
        return {name: name for name in values}


def _modulated(graph: GraphBuilder, rows: _Rows, part: str, factors: np.ndarray | None, deltas: str) -> str:
    """The summed deltas times the factors of the rows, if there are any (equation 12)."""
    if factors is None:
        return deltas
    name = f"{part.removesuffix('s')}_modulation"
    return graph.node("Mul", [rows.of(name, factors), deltas], f"{name}.applied")


def _appearance(
    graph: GraphBuilder, rows: _Rows, name: str, values: np.ndarray, deltas: str | None, gains: str | None
) -> str:
    """Opacities, [R, 1], or SH, [R, 3 C], plus their deltas; colors of SH times 1 + gains, [R, 3]."""
    canonical = rows.of(f"canonical_{name}", values.reshape(len(values), -1))
    if name == "sh" and gains is not None:
        canonical = _shaded(graph, canonical, gains, values.shape[1])
    if deltas is not None:
        canonical = graph.node("Add", [canonical, deltas], f"{name}.moved")
    return graph.node("Sigmoid", [canonical], f"{name}.activated") if name == "opacities" else canonical


def _shaded(graph: GraphBuilder, sh: str, gains: str, coefficients: int) -> str:
    """[R, 3 C] SH of colors times 1 + gains: a color is 0.5 plus the sum of its bands."""
    every = graph.constant("shading.bands", np.tile(np.eye(3, dtype=np.float32), coefficients))
    half = np.zeros(3 * coefficients, np.float32)
    half[:3] = 0.5 / SH_C0
    colors = graph.node("Add", [sh, graph.constant("shading.half", half)], "shading.colors")
    added = graph.node("Mul", [graph.node("MatMul", [gains, every], "shading.gains"), colors], "shading.added")
    return graph.node("Add", [sh, added], "shading.sh")


def _scales(graph: GraphBuilder, log_scales: str, deltas: str | None, delta_space: str, output: str) -> None:
    """The output `scales`: deltas, if there are any, are added before or after the exponential."""
    limits = [
        graph.constant(f"log_scales.{name}", np.array(limit, np.float32))
        for name, limit in (("min", -LOG_SCALE_LIMIT), ("max", LOG_SCALE_LIMIT))
    ]
    if deltas is not None and delta_space == "raw":
        log_scales, deltas = graph.node("Add", [log_scales, deltas], "log_scales"), None
    bounded = graph.node("Clip", [log_scales, *limits], "log_scales.bounded")
    canonical = graph.node("Exp", [bounded], output if deltas is None else "ids.scales")
    if deltas is not None:
        signed = graph.node("Add", [canonical, deltas], "scales.signed")
        minus = graph.node("Mul", [signed, graph.constant("scales.minus", np.array(-1, np.float32))], "scales.negated")
        least = graph.constant("scales.min", np.array(MIN_SCALE, np.float32))
        graph.node("Max", [graph.node("Max", [signed, minus], "scales.absolute"), least], output)


def prefix(baked: Baked, count: int) -> onnx.ModelProto:
    """The scene with its first `count` layers as trained."""
    layers, scene, moving = baked.layers[:count], baked.scene, baked.moving
    sh = moving.appearance.get("sh")
    if sh is not None and not heads_of(layers[0]).sh and not any(layer.shades for layer in layers):
        changing = tuple(name for name in scene.changing if name != "sh")
        scene = replace(scene, sh=np.concatenate([sh, scene.sh]), changing=changing)
        moving = replace(moving, appearance={name: moving.appearance[name] for name in changing})
    scene = replace(scene, metadata=replace(scene.metadata, layers=scene.metadata.layers[:count]))
    return network(replace(baked, layers=layers, scene=scene, moving=moving), f"prefix:{count}")


NETWORK = Plan("network", "network", "#4269d0", lambda baked, spec, sample: network(baked))
PREFIX = Plan(
    "prefix",
    "prefix:k, the first k layers",
    "#6cc5b0",
    lambda baked, spec, sample: prefix(baked, spec.count or 0),
    candidates=lambda layers: [f"prefix:{k}" for k in range(1, layers)],
    counts=range(1, 1_001),
    counts_layers=True,
)

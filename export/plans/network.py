"""Plan `network`: all layers in float32 as the model computes them."""

from dataclasses import replace

import numpy as np
import onnx
import torch

from export.jobs.bake import Baked, Layer, Moving
from export.layers.graph import GraphBuilder, to_numpy
from export.layers.plane import plane_heads
from export.layers.spline import basis_deltas
from export.plans.scene_graph import finished, new_graph, unit_quats
from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.gaussians.model import LOG_SCALE_LIMIT, MIN_SCALE
from msdgs_train.layers.mlp import MLPLayer
from msdgs_train.layers.plane import PlaneLayer
from msdgs_train.supports.nodes import BasisLayer

DELTAS = {"means": slice(0, 3), "scales": slice(3, 6), "quats": slice(6, 10)}
"""Columns of the heads, in the order of `Heads.sizes`, whose last column, if there is one, is the weight."""


def network(baked: Baked, plan: str = "network") -> onnx.ModelProto:
    """The scene with all its layers, exactly as trained."""
    graph = new_graph(baked)
    _deform(graph, baked.moving, baked.layers, baked.scene.metadata.delta_space)
    return finished(graph, baked, plan)


def _deform(graph: GraphBuilder, moving: Moving, layers: tuple[Layer, ...], delta_space: str) -> None:
    """Canonical values of the ids, moved by each layer in turn, then activated: `DynamicGaussians.pose`."""
    means = graph.node("Gather", [graph.constant("canonical_means", moving.means), "ids"], "ids.means")
    log_scales = graph.node(
        "Gather", [graph.constant("canonical_log_scales", moving.log_scales), "ids"], "ids.log_scales"
    )
    quats = graph.node("Gather", [graph.constant("canonical_quats", moving.quats), "ids"], "ids.quats")
    time = graph.node("Reshape", ["t", graph.constant("time_shape", np.array([1, 1], np.int64))], "time")

    steps = graph.constant("steps", np.array([len(layers)], np.float32))
    used = used_heads(layers)
    sizes = [DELTAS[part].stop - DELTAS[part].start for part in used]
    deltas, moved, parts = "", means, dict[str, str]()
    for k, layer in enumerate(layers, start=1):
        name = f"layer{k}"
        share = _share(graph, name, steps, k)
        if isinstance(layer, BasisLayer):
            step = basis_deltas(graph, name, layer, moving, means, quats, time, used, share)
        else:
            step = _layer(graph, name, layer, moved, time, used, share)  # equation 7
        deltas = graph.node("Add", [deltas, step], f"{name}.deltas") if deltas else step  # equation 9
        parts = dict(zip(used, graph.split(deltas, [f"{name}.{part}" for part in used], sizes), strict=True))
        if k < len(layers) and "means" in parts:
            moved = graph.node("Add", [means, parts["means"]], f"{name}.moved")  # equation 8

    factors = {"means": moving.mean_modulation, "scales": moving.scale_modulation, "quats": moving.quat_modulation}
    parts = {part: _modulated(graph, part, factors[part], value) for part, value in parts.items()}
    graph.node(*(("Add", [means, parts["means"]]) if "means" in parts else ("Identity", [means])), "means")
    _scales(graph, log_scales, parts.get("scales"), delta_space)
    unit_quats(graph, graph.node("Add", [quats, parts["quats"]], "raw_quats") if "quats" in parts else quats)


def used_heads(layers: tuple[Layer, ...]) -> list[str]:
    """Those of the heads that are not all zeros in all layers; one at least."""
    used = [name for name, columns in DELTAS.items() if any(_changes(layer, columns) for layer in layers)]
    return used or ["means"]


def _changes(layer: Layer, columns: slice) -> bool:
    if isinstance(layer, BasisLayer):
        return True
    if isinstance(layer, MLPLayer):
        return bool(layer.heads.weight[columns].any() or layer.heads.bias[columns].any())
    return any(bool(p.any()) for p in layer.heads[list(DELTAS.values()).index(columns)].parameters())


def _rows(layer: MLPLayer | PlaneLayer, used: list[str]) -> np.ndarray:
    """Columns of the heads' output that are computed."""
    deltas = [np.arange(10)[DELTAS[part]] for part in used]
    return np.concatenate([*deltas, [10]] if layer.outputs.weight else deltas)


def _modulated(graph: GraphBuilder, part: str, factors: np.ndarray | None, deltas: str) -> str:
    """Equation 12: the summed deltas times the factors of the ids, if there are any."""
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


def _share(graph: GraphBuilder, name: str, steps: str, k: int) -> str:
    """[1] how much of layer k is applied after `steps`: all, nothing, or a part of the last one."""
    before = graph.constant(f"{name}.before", np.array([k - 1], np.float32))
    limits = [graph.constant(f"{name}.share.{n}", np.array(v, np.float32)) for n, v in (("min", 0), ("max", 1))]
    return graph.node("Clip", [graph.node("Sub", [steps, before], f"{name}.steps"), *limits], f"{name}.share")


def _layer(
    graph: GraphBuilder, name: str, layer: MLPLayer | PlaneLayer, means: str, time: str, used: list[str], share: str
) -> str:
    """One layer at the means [M, 3]: the deltas of the heads that are used, times its share, and its weight if it
    predicts one."""
    rows = _rows(layer, used)
    if isinstance(layer, MLPLayer):
        heads = _mlp_heads(graph, name, layer, means, time, rows)
    else:
        heads = plane_heads(graph, name, layer, means, time, rows)
    if not layer.outputs.weight:
        return graph.node("Mul", [heads, share], f"{name}.shared")
    deltas, logit = graph.split(heads, [f"{name}.unweighted", f"{name}.logit"], [len(rows) - 1, 1])
    weight = graph.node("Sigmoid", [logit], f"{name}.weight")
    return graph.node("Mul", [graph.node("Mul", [weight, share], f"{name}.shared"), deltas], f"{name}.weighted")


def _mlp_heads(graph: GraphBuilder, name: str, layer: MLPLayer, means: str, time: str, rows: np.ndarray) -> str:
    """[M, len(rows)] what the heads of one layer say of means [M, 3]: deltas, then the weight before its sigmoid."""
    encoded, code = (
        _encode(graph, f"{name}.xyz", means, layer.xyz_frequency_matrix),
        _time_code(graph, name, layer, time),
    )
    hidden = _read_input(graph, f"{name}.first", layer, layer.first, encoded, code)
    hidden = graph.node("Relu", [hidden], f"{name}.first.relu")
    for i, linear in enumerate(layer.trunk):
        trunk = f"{name}.trunk{i}"
        if i + 1 == layer.skip:
            read = _read_input(graph, trunk, layer, linear, encoded, code)
            weight = graph.constant(f"{trunk}.weight", to_numpy(linear.weight)[:, layer.input_features :])
            out = graph.node("Gemm", [hidden, weight, read], f"{trunk}.out", transB=1)
        else:
            out = _linear(graph, trunk, linear, hidden)
        hidden = graph.node("Relu", [out], f"{trunk}.relu")
    weight = graph.constant(f"{name}.heads.weight", to_numpy(layer.heads.weight)[rows])
    bias = graph.constant(f"{name}.heads.bias", to_numpy(layer.heads.bias)[rows])
    return graph.node("Gemm", [hidden, weight, bias], f"{name}.heads.out", transB=1)


def _time_code(graph: GraphBuilder, name: str, layer: MLPLayer, time: str) -> str:
    """[1, time_features] what the layer knows of the time: one row a call, whatever the number of ids."""
    encoded = _encode(graph, f"{name}.time", time, layer.time_frequency_matrix)
    hidden = graph.node(
        "Relu", [_linear(graph, f"{name}.time_hidden", layer.time_hidden, encoded)], f"{name}.time_relu"
    )
    return _linear(graph, f"{name}.time_output", layer.time_output, hidden)


def _read_input(
    graph: GraphBuilder, name: str, layer: MLPLayer, linear: torch.nn.Module, encoded: str, code: str
) -> str:
    """[M, width] the part of a Linear that reads encoded means and, as a bias of one row a call, time."""
    weight = to_numpy(linear.weight)
    weight_time = graph.constant(f"{name}.weight_time", weight[:, layer.xyz_features : layer.input_features])
    bias = graph.constant(f"{name}.bias", to_numpy(linear.bias))
    time_bias = graph.node("Gemm", [code, weight_time, bias], f"{name}.time_bias", transB=1)
    weight_xyz = graph.constant(f"{name}.weight_xyz", weight[:, : layer.xyz_features])
    return graph.node("Gemm", [encoded, weight_xyz, time_bias], f"{name}.read", transB=1)


def _encode(graph: GraphBuilder, name: str, value: str, frequency_matrix: torch.Tensor) -> str:
    """`PositionalEncoding`: value, sines, cosines side by side."""
    phases = graph.node(
        "MatMul", [value, graph.constant(f"{name}.octaves", to_numpy(frequency_matrix))], f"{name}.phases"
    )
    sines = graph.node("Sin", [phases], f"{name}.sines")
    cosines = graph.node("Cos", [phases], f"{name}.cosines")
    return graph.node("Concat", [value, sines, cosines], f"{name}.encoded", axis=1)


def _linear(graph: GraphBuilder, name: str, linear: torch.nn.Module, value: str) -> str:
    weight = graph.constant(f"{name}.weight", to_numpy(linear.weight))
    bias = graph.constant(f"{name}.bias", to_numpy(linear.bias))
    return graph.node("Gemm", [value, weight, bias], f"{name}.out", transB=1)


def prefix(baked: Baked, count: int) -> onnx.ModelProto:
    """The scene with its first `count` layers. Raises `InvalidInput` where it hasn't as many."""
    if count > len(baked.layers):
        raise InvalidInput("plan", f"prefix:k with k from 1 to {len(baked.layers)}, this model's layers", count)
    metadata = replace(baked.scene.metadata, layers=baked.scene.metadata.layers[:count])
    scene = replace(baked.scene, metadata=metadata)
    return network(replace(baked, layers=baked.layers[:count], scene=scene), f"prefix:{count}")

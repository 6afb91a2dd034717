"""Plan `network`: all layers in float32 as the model computes them."""

import numpy as np
import onnx
import torch

from export.bake import Baked, Layer, Moving
from export.graph import GraphBuilder, to_numpy
from export.plane_graph import plane_heads
from export.plans.scene_graph import finished, new_graph, unit_quats
from msdgs_train.layers import MLPLayer
from msdgs_train.model import LOG_SCALE_LIMIT

DELTA_COLUMNS = 10
"""Means 3, log_scales 3, quats 4: the order of `MLPLayer.heads`, whose last column is the weight."""


def network(baked: Baked, plan: str = "network") -> onnx.ModelProto:
    """The scene with all its layers, exactly as trained."""
    graph = new_graph(baked)
    _deform(graph, baked.moving, baked.layers)
    return finished(graph, baked, plan)


def _deform(graph: GraphBuilder, moving: Moving, layers: tuple[Layer, ...]) -> None:
    """Canonical values of the ids, moved by each layer in turn, then activated: `DynamicGaussians.pose`."""
    means = graph.node("Gather", [graph.constant("canonical_means", moving.means), "ids"], "ids.means")
    log_scales = graph.node(
        "Gather", [graph.constant("canonical_log_scales", moving.log_scales), "ids"], "ids.log_scales"
    )
    quats = graph.node("Gather", [graph.constant("canonical_quats", moving.quats), "ids"], "ids.quats")
    time = graph.node("Reshape", ["t", graph.constant("time_shape", np.array([1, 1], np.int64))], "time")

    deltas, moved, parts = "", means, [""] * 3
    for k, layer in enumerate(layers, start=1):
        name = f"layer{k}"
        step = _layer(graph, name, layer, moved, time)  # equation 7
        deltas = graph.node("Add", [deltas, step], f"{name}.deltas") if deltas else step  # equation 9
        parts = graph.split(deltas, [f"{name}.means", f"{name}.log_scales", f"{name}.quats"], [3, 3, 4])
        moved = graph.node("Add", [means, parts[0]], f"{name}.moved" if k < len(layers) else "means")  # equation 8

    _, delta_log_scales, delta_quats = parts
    if moving.scale_modulation is not None:
        modulation = graph.constant("scale_modulation", moving.scale_modulation)
        factors = graph.node("Gather", [modulation, "ids"], "ids.scale_modulation")
        delta_log_scales = graph.node("Mul", [factors, delta_log_scales], "modulated")  # equation 12
    log_scales = graph.node("Add", [log_scales, delta_log_scales], "log_scales")
    limits = [
        graph.constant(f"log_scales.{name}", np.array(limit, np.float32))
        for name, limit in (("min", -LOG_SCALE_LIMIT), ("max", LOG_SCALE_LIMIT))
    ]
    bounded = graph.node("Clip", [log_scales, *limits], "log_scales.bounded")
    graph.node("Exp", [bounded], "scales")
    unit_quats(graph, graph.node("Add", [quats, delta_quats], "raw_quats"))


def _layer(graph: GraphBuilder, name: str, layer: Layer, means: str, time: str) -> str:
    """One layer at the means [M, 3]: its deltas, [M, 10], times its weight."""
    if isinstance(layer, MLPLayer):
        heads = _mlp_heads(graph, name, layer, means, time)
    else:
        heads = plane_heads(graph, name, layer, means, time)
    deltas, logit = graph.split(heads, [f"{name}.unweighted", f"{name}.logit"], [DELTA_COLUMNS, 1])
    weight = graph.node("Sigmoid", [logit], f"{name}.weight")
    return graph.node("Mul", [weight, deltas], f"{name}.weighted")


def _mlp_heads(graph: GraphBuilder, name: str, layer: MLPLayer, means: str, time: str) -> str:
    """[M, 11] what the heads of one layer say of means [M, 3]: deltas, and the weight before its sigmoid."""
    encoded = _encode(graph, f"{name}.xyz", means, layer.xyz_octaves)
    first = to_numpy(layer.first.weight)
    weight_xyz = graph.constant(f"{name}.first.weight_xyz", first[:, : layer.xyz_features])
    hidden = graph.node(
        "Gemm", [encoded, weight_xyz, _time_bias(graph, name, layer, time)], f"{name}.first.out", transB=1
    )
    hidden = graph.node("Relu", [hidden], f"{name}.first.relu")
    for i, linear in enumerate(layer.trunk):
        hidden = _linear(graph, f"{name}.trunk{i}", linear, hidden)
        hidden = graph.node("Relu", [hidden], f"{name}.trunk{i}.relu")
    return _linear(graph, f"{name}.heads", layer.heads, hidden)


def _time_bias(graph: GraphBuilder, name: str, layer: MLPLayer, time: str) -> str:
    """[1, width] what time adds to the first Linear, its bias included: one row a call, whatever the number of ids."""
    encoded = _encode(graph, f"{name}.time", time, layer.time_octaves)
    hidden = graph.node(
        "Relu", [_linear(graph, f"{name}.time_hidden", layer.time_hidden, encoded)], f"{name}.time_relu"
    )
    features = _linear(graph, f"{name}.time_output", layer.time_output, hidden)
    weight = graph.constant(f"{name}.first.weight_time", to_numpy(layer.first.weight)[:, layer.xyz_features :])
    bias = graph.constant(f"{name}.first.bias", to_numpy(layer.first.bias))
    return graph.node("Gemm", [features, weight, bias], f"{name}.time_bias", transB=1)


def _encode(graph: GraphBuilder, name: str, value: str, octaves: torch.Tensor) -> str:
    """`PositionalEncoding`: value, sines, cosines side by side."""
    phases = graph.node("MatMul", [value, graph.constant(f"{name}.octaves", to_numpy(octaves))], f"{name}.phases")
    sines = graph.node("Sin", [phases], f"{name}.sines")
    cosines = graph.node("Cos", [phases], f"{name}.cosines")
    return graph.node("Concat", [value, sines, cosines], f"{name}.encoded", axis=1)


def _linear(graph: GraphBuilder, name: str, linear: torch.nn.Module, value: str) -> str:
    weight = graph.constant(f"{name}.weight", to_numpy(linear.weight))
    bias = graph.constant(f"{name}.bias", to_numpy(linear.bias))
    return graph.node("Gemm", [value, weight, bias], f"{name}.out", transB=1)

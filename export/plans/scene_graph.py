"""What the graphs of all plans share: their inputs, constant outputs and metadata, and how raw values are activated."""

from dataclasses import replace

import numpy as np
import onnx
from onnx import TensorProto

from export.bake import Baked
from export.graph import GraphBuilder
from msdgs_serve.scene.baked import CONSTANT_OUTPUTS
from msdgs_serve.scene.quaternion import MIN_NORM


def new_graph(baked: Baked) -> GraphBuilder:
    """A graph that knows `ids`, all of them by default."""
    graph = GraphBuilder()
    graph.constant("ids", np.arange(len(baked.moving), dtype=np.int64))
    return graph


def finished(graph: GraphBuilder, baked: Baked, plan: str) -> onnx.ModelProto:
    """The whole scene file of a graph that computes `means`, `quats` and `scales`, or holds them as constants."""
    scene = baked.scene
    count: int | str = "M" if scene.moving_count else 0
    outputs: dict[str, list[int | str]] = {"means": [count, 3], "quats": [count, 4], "scales": [count, 3]}
    for name in CONSTANT_OUTPUTS:
        array = getattr(scene, name)
        graph.constant(name, array)
        outputs[name] = list(array.shape)
    inputs = {"t": (TensorProto.FLOAT, [1]), "ids": (TensorProto.INT64, ["M"])}
    return graph.model(inputs, outputs, replace(scene.metadata, plan=plan).to_properties())


def still(baked: Baked, plan: str) -> onnx.ModelProto:
    """A scene in which nothing moves: under any plan a graph of no nodes."""
    graph = new_graph(baked)
    for name, columns in (("means", 3), ("quats", 4), ("scales", 3)):
        graph.constant(name, np.empty((0, columns), np.float32))
    return finished(graph, baked, plan)


def unit_quats(graph: GraphBuilder, raw: str) -> None:
    """The output `quats`: unit length; identity where the norm is under 1e-8, as `msdgs_train.model.unit_quats`."""
    axis = graph.constant("quats.axis", np.array([1], np.int64))
    least = graph.constant("quats.min_norm", np.array(MIN_NORM, np.float32))
    identity = graph.constant("quats.identity", np.array([[1, 0, 0, 0]], np.float32))
    norms = graph.node("ReduceL2", [raw, axis], "quats.norms", keepdims=1)
    scaled = graph.node("Div", [raw, graph.node("Max", [norms, least], "quats.divisors")], "quats.scaled")
    graph.node("Where", [graph.node("Less", [norms, least], "quats.tiny"), identity, scaled], "quats")

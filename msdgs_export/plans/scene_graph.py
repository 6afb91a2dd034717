"""Parts of the graphs of all plans: inputs, constant outputs and metadata, and activations."""

from dataclasses import replace
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto

from msdgs_export.bake import Baked
from msdgs_export.layers.graph import GraphBuilder
from msdgs_serve.scene.baked import CONSTANT_OUTPUTS, CONTRACT, BakedScene, constant_outputs
from msdgs_serve.scene.metadata import CHANGING_CONTRACT
from msdgs_serve.scene.quaternion import MIN_NORM
from msdgs_train.gaussians.scale_space import MIN_SCALE


def new_graph(baked: Baked) -> GraphBuilder:
    """A graph with the input `ids`, by default all."""
    graph = GraphBuilder()
    graph.constant("ids", np.arange(len(baked.moving), dtype=np.int64))
    return graph


def finished(graph: GraphBuilder, baked: Baked, plan: str, fitted: dict[str, Any] | None = None) -> onnx.ModelProto:
    """The scene file of a graph that computes `means`, `quats`, `scales` and what is `changing`, or holds them as
    constants.

    `fitted` is what a fitted plan says of its error.
    """
    scene = baked.scene
    has_ids = "ids" in graph.constants
    count: int | str = "M" if has_ids and scene.moving_count else scene.moving_count
    outputs: dict[str, list[int | str]] = {"means": [count, 3], "quats": [count, 4], "scales": [count, 3]}
    outputs |= {name: [count, *getattr(scene, name).shape[1:]] for name in scene.changing}
    for name, stored in zip(constant_outputs(scene.changing), CONSTANT_OUTPUTS, strict=True):
        array = getattr(scene, stored)
        graph.constant(name, array)
        outputs[name] = list(array.shape)
    inputs: dict[str, tuple[int, list[int | str]]] = {"t": (TensorProto.FLOAT, [1])}
    if has_ids:
        inputs["ids"] = (TensorProto.INT64, ["M"])
    if "steps" in graph.constants:
        inputs["steps"] = (TensorProto.FLOAT, [1])
    contract = CHANGING_CONTRACT if scene.changing else CONTRACT
    metadata = replace(
        scene.metadata, contract=contract, plan=plan, measured_error={"fitted": fitted} if fitted else {}
    )
    return graph.model(inputs, outputs, metadata.to_properties())


def static_graph(baked: Baked, plan: str) -> onnx.ModelProto:
    """The scene file of a scene in which nothing moves: a graph without nodes."""
    graph = new_graph(baked)
    for name, columns in (("means", 3), ("quats", 4), ("scales", 3)):
        graph.constant(name, np.empty((0, columns), np.float32))
    return finished(graph, baked, plan)


def activated(graph: GraphBuilder, pose: str) -> None:
    """Add the outputs of raw poses, [M, 10]: means, scales that may be negative, quaternions of any norm."""
    graph.split(pose, ["means", "raw_scales", "raw_quats"], [3, 3, 4])
    graph.node("Max", ["raw_scales", graph.constant("scales.min", np.array(MIN_SCALE, np.float32))], "scales")
    unit_quats(graph, "raw_quats")


def changing_output(graph: GraphBuilder, scene: BakedScene, name: str, rows: str) -> None:
    """Add the output `opacities` or `sh` of activated values, [M, 1] or [M, 3 C]."""
    shape = graph.constant(f"{name}.shape", np.array([-1, *getattr(scene, name).shape[1:]], np.int64))
    graph.node("Reshape", [rows, shape], name)


def unit_quats(graph: GraphBuilder, raw: str, output: str = "quats") -> None:
    """Add the output `quats`: normalized, or the identity if the norm is under 1e-8, as in `unit_or_identity`.

    Sums of squares and the identity are products with constants, which take 1 ms for 106,500 rows; ReduceL2 takes 7 ms
    and Where 3 ms.
    """
    ones = graph.constant("quats.ones", np.ones((4, 4), np.float32))
    least = graph.constant("quats.min_norm", np.array(MIN_NORM, np.float32))
    first = graph.constant("quats.first", np.diag([1, 0, 0, 0]).astype(np.float32))
    sums = graph.node("MatMul", [graph.node("Mul", [raw, raw], "quats.squares"), ones], "quats.sums")
    norms = graph.node("Sqrt", [sums], "quats.norms")  # [M, 4], equal in a row
    none = graph.node("Cast", [graph.node("Less", [norms, least], "quats.tiny")], "quats.none", to=TensorProto.FLOAT)
    some = graph.node("Gemm", [none, first, raw], "quats.some")
    graph.node("Div", [some, graph.node("Max", [norms, none], "quats.divisors")], output)

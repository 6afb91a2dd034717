"""A check of Visionary's rules for ONNX models."""

import numpy as np
import onnx
import onnxruntime as ort
from onnx import TensorProto, numpy_helper

from msdgs_serve.scene.errors import MsdgsError

OPSET = 17
MULTIPLE = 256
"""Rows are padded to a multiple of this with Gaussians of opacity 0."""

COLUMNS, COLOR_COLUMNS, OPACITY = 10, 48, 3
GAUSSIANS, COLORS, COUNT = "gaussian_f32", "color_f16", "num_points"
GAUSSIAN_TYPES = {GAUSSIANS: TensorProto.FLOAT, "gaussian_f16": TensorProto.FLOAT16}
"""Both are allowed; this project writes float32."""

CONTROL_FLOW = {"If", "Loop", "Scan", "SequenceMap"}
QUANTISED = {"QuantizeLinear", "DequantizeLinear"}
GRAPH_TYPES = {TensorProto.FLOAT, TensorProto.INT32, TensorProto.INT64, TensorProto.BOOL}
"""Types of values that aren't outputs."""

RESERVED = ("sh", "color", "rgb")


class VisionaryInvalid(MsdgsError):
    """A model breaks a rule of Visionary."""


def check_visionary(model: onnx.ModelProto) -> None:
    """Raise `VisionaryInvalid` listing all rules that a model breaks."""
    problems = [*_interface_problems(model), *_graph_problems(model)]
    if not problems:
        problems = _padding_problems(model)
    if problems:
        raise VisionaryInvalid("; ".join(problems))


def _interface_problems(model: onnx.ModelProto) -> list[str]:
    problems = []
    opsets = {each.domain: each.version for each in model.opset_import}
    if opsets != {"": OPSET}:
        problems.append(f"operator sets {opsets} instead of {OPSET} alone")
    if [_kind(each) for each in model.graph.input] != [("time", TensorProto.FLOAT, [1])]:
        problems.append("its input must be `time`, float32 [1], alone")
    outputs = {name: (kind, shape) for name, kind, shape in map(_kind, model.graph.output)}
    gaussians = next((name for name in GAUSSIAN_TYPES if name in outputs), GAUSSIANS)
    rows = outputs.get(gaussians, (0, [0]))[1][0]
    expected = {
        gaussians: (GAUSSIAN_TYPES[gaussians], [rows, COLUMNS]),
        COLORS: (TensorProto.FLOAT16, [rows, COLOR_COLUMNS]),
        COUNT: (TensorProto.INT32, [1]),
    }
    problems += [f"output `{name}` must be {kind}" for name, kind in expected.items() if outputs.get(name) != kind]
    if not rows or rows % MULTIPLE:
        problems.append(f"{rows} rows are no multiple of {MULTIPLE}")
    others = [name for name in outputs if name not in expected and any(word in name for word in RESERVED)]
    return problems + [f"output `{name}` would be taken for colors" for name in others]


def _graph_problems(model: onnx.ModelProto) -> list[str]:
    graph, outputs = model.graph, {each.name for each in model.graph.output}
    problems = [f"function `{each.name}` is its own" for each in model.functions]
    to_outputs = {name for node in graph.node if outputs & set(node.output) for name in node.input}
    stored = list(graph.initializer)
    for node in graph.node:
        if node.op_type in CONTROL_FLOW or any(attribute.HasField("g") for attribute in node.attribute):
            problems.append(f"{node.op_type} is control flow")
        if node.op_type in QUANTISED:
            problems.append(f"{node.op_type} isn't float32")
        for attribute in node.attribute:
            if node.op_type == "Cast" and attribute.name == "to" and not outputs & set(node.output):
                problems += _type_problems(f"Cast to `{node.output[0]}`", attribute.i)
            if attribute.HasField("t"):
                named = TensorProto.FromString(attribute.t.SerializeToString())
                named.name = node.output[0]
                stored.append(named)
    for each in stored:
        if not (each.name in to_outputs | outputs and each.data_type == TensorProto.FLOAT16):
            problems += _type_problems(f"constant `{each.name}`", each.data_type)
        if each.data_location == TensorProto.EXTERNAL:
            problems.append(f"constant `{each.name}` is stored in another file")
        elif not np.isfinite(numpy_helper.to_array(each).astype(np.float64)).all():
            problems.append(f"constant `{each.name}` holds NaN or infinity")
    return problems


def _type_problems(what: str, kind: int) -> list[str]:
    return [] if kind in GRAPH_TYPES else [f"{what} is {TensorProto.DataType.Name(kind)}, not float32"]


def _padding_problems(model: onnx.ModelProto) -> list[str]:
    """Run the model once: rows from `num_points` on must have opacity 0."""
    session = ort.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    gaussians = next(each.name for each in model.graph.output if each.name in GAUSSIAN_TYPES)
    rows, count = (np.asarray(a) for a in session.run([gaussians, COUNT], {"time": np.zeros(1, np.float32)}))
    if not 0 <= count[0] <= len(rows):
        return [f"`{COUNT}` is {count[0]} of {len(rows)} rows"]
    return ["its padding has opacities other than 0"] if rows[count[0] :, OPACITY].any() else []


def _kind(value: onnx.ValueInfoProto) -> tuple[str, int, list[int]]:
    tensor = value.type.tensor_type
    return value.name, tensor.elem_type, [each.dim_value for each in tensor.shape.dim]

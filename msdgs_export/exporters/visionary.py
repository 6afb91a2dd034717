"""ONNX for Visionary in a browser: time as input, packed Gaussians and colors as outputs.

The graph is the scene's own for all ids. Everything that doesn't depend on time is computed here, and covariances
replace rotations and scales.
"""

from pathlib import Path

import numpy as np
import onnx
import onnxruntime as ort
from onnx import NodeProto, TensorProto, helper, numpy_helper

from msdgs_export.importers.splats.base import as_float32
from msdgs_export.layers.graph import GraphBuilder
from msdgs_export.layers.rotations import quaternion_products
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.scene.baked import BakedScene
from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.scene.gaussians import Gaussians
from msdgs_serve.scene.quaternion import from_matrix, to_matrix

OPSET, IR_VERSION = 17, 8
GAUSSIANS, COLORS, COUNT = "gaussian_f32", "color_f16", "num_points"
COLUMNS, COLOR_COLUMNS = 10, 48
MULTIPLE = 256
"""Rows are padded to a multiple of this with Gaussians of opacity 0."""

QUANTIZED = {"QuantizeLinear", "DequantizeLinear"}
PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
"""Rows and columns of the stored entries of a covariance: xx xy xz yy yz zz."""


def visionary_model(scene_file: Path) -> onnx.ModelProto:
    """The model of a scene file. Raises `InvalidInput` for one with products in 8 bits, as older exporters wrote, which
    no browser runs on its GPU."""
    scene = DeformationSession(scene_file).scene
    source = onnx.load(scene_file)
    if any(node.op_type in QUANTIZED for node in source.graph.node):
        plan = scene.metadata.plan
        raise InvalidInput("scene", "of another plan, for example compact: msdgs-export --plan compact:65", plan)
    graph = GraphBuilder()
    rows = []
    if scene.moving_count:
        _moving(graph, source.graph, scene.posed_outputs)
        rows.append(_packed(graph, scene))
    count = len(scene)
    padding = -count % MULTIPLE
    rest = np.concatenate([_packed_static(scene), np.zeros((padding, COLUMNS), np.float32)])
    rows.append(graph.constant("static_rows", rest))
    graph.node("Concat", rows, GAUSSIANS, axis=0)
    stored, columns = len(scene.sh), 3 * scene.sh.shape[1]
    colors = np.zeros((stored + padding, COLOR_COLUMNS), np.float16)
    colors[:stored, :columns] = scene.sh.reshape(stored, columns)
    harmonics = graph.constant("harmonics", colors)
    if "sh" in scene.changing:
        graph.node("Concat", [_moving_colors(graph, scene), harmonics], COLORS, axis=0)
    else:
        graph.node("Identity", [harmonics], COLORS)
    graph.node("Identity", [graph.constant("count", np.array([count], np.int32))], COUNT)
    shapes = {GAUSSIANS: [count + padding, COLUMNS], COLORS: [count + padding, COLOR_COLUMNS], COUNT: [1]}
    types, time = {COLORS: TensorProto.FLOAT16, COUNT: TensorProto.INT32}, {"time": (TensorProto.FLOAT, [1])}
    return graph.model(time, shapes, {}, types=types, name="msdgs_visionary", opset=OPSET, ir_version=IR_VERSION)


def _moving_colors(graph: GraphBuilder, scene: BakedScene) -> str:
    """[M, 48] in float16, from `sh`."""
    columns = 3 * scene.sh.shape[1]
    rows = graph.node("Reshape", ["sh", graph.constant("sh.rows", np.array([-1, columns]))], "sh.flat")
    if columns < COLOR_COLUMNS:
        rest = graph.constant("sh.rest", np.zeros((scene.moving_count, COLOR_COLUMNS - columns), np.float32))
        rows = graph.node("Concat", [rows, rest], "sh.padded", axis=1)
    return graph.node("Cast", [rows], "sh.half", to=TensorProto.FLOAT16)


def _moving(graph: GraphBuilder, source: onnx.GraphProto, outputs: tuple[str, ...]) -> None:
    """Copy the nodes of a scene's graph that depend on time, its input `t` as `time`; all others become constants."""
    known = {each.name: numpy_helper.to_array(each) for each in source.initializer}
    changing, nodes = {"t"}, list[NodeProto]()
    for node in source.node:
        if changing & set(node.input):
            changing |= set(node.output)
            nodes.append(node)
    static = [node for node in source.node if node not in nodes]
    needed = {name for node in nodes for name in node.input} | {*outputs}
    known |= _computed(static, source, sorted(needed & {name for node in static for name in node.output}))
    axes = {node.input[1] for node in nodes if node.op_type == "ReduceProd"}  # attributes in opset 17
    for name in sorted((needed & set(known)) - axes):
        values = known[name]
        graph.constant(name, values.astype(np.float32) if values.dtype in (np.int16, np.float16) else values)
    for node in nodes:
        copied = NodeProto.FromString(node.SerializeToString())
        copied.input[:] = [_RENAMED.get(name, name) for name in node.input]
        copied.output[:] = [_RENAMED.get(name, name) for name in node.output]
        if node.op_type == "ReduceProd":
            copied.attribute.append(helper.make_attribute("axes", known[copied.input.pop()].reshape(-1)))
        graph.nodes.append(copied)


_RENAMED = {"t": "time", "time": "scene.time"}
"""Values of a scene's graph that have another name here."""


def _computed(nodes: list[NodeProto], source: onnx.GraphProto, names: list[str]) -> dict[str, np.ndarray]:
    """Compute values that don't depend on time."""
    if not names:
        return {}
    outputs = [onnx.ValueInfoProto(name=name) for name in names]
    read = {name for node in nodes for name in node.input}
    constants = [each for each in source.initializer if each.name in read]
    graph = helper.make_graph(nodes, "still", [], outputs, constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    session = ort.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    return dict(zip(names, session.run(names, {}), strict=True))  # type: ignore[arg-type]


def _packed(graph: GraphBuilder, scene: BakedScene) -> str:
    """[M, 10] position, opacity and covariance R S Sᵀ Rᵀ, from `means`, `quats`, `scales` and changing `opacities`."""
    first, second, factors = quaternion_products()
    matrix_of = (factors + (first == second)[:, None, None] * np.eye(3, dtype=np.float32)).reshape(10, 9)
    monomials = graph.node("Mul", [_take(graph, "quats", first), _take(graph, "quats", second)], "quats.monomials")
    matrix = graph.node("MatMul", [monomials, graph.constant("quats.to_matrix", matrix_of)], "rotation")
    axes = graph.node("Mul", [matrix, _take(graph, "scales", [0, 1, 2] * 3)], "axes")  # rows of R S
    left = _take(graph, axes, [3 * i + k for i, _ in PAIRS for k in range(3)])
    right = _take(graph, axes, [3 * j + k for _, j in PAIRS for k in range(3)])
    sums = graph.constant("covariance.sums", np.kron(np.eye(6), np.ones((3, 1))).astype(np.float32))
    covariances = graph.node("MatMul", [graph.node("Mul", [left, right], "covariance.terms"), sums], "covariance")
    if "opacities" in scene.changing:
        column = graph.node("Reshape", ["opacities", graph.constant("opacity.column", np.array([-1, 1]))], "opacity")
    else:
        column = graph.constant("opacity", scene.opacities[: scene.moving_count, None])
    return graph.node("Concat", ["means", column, covariances], "moving_rows", axis=1)


def _take(graph: GraphBuilder, value: str, columns: list[int] | np.ndarray) -> str:
    name = f"{value}.take{len(graph.nodes)}"
    indices = graph.constant(f"{name}.columns", np.array(columns, np.int64))
    return graph.node("Gather", [value, indices], name, axis=1)


def _packed_static(scene: BakedScene) -> np.ndarray:
    axes = to_matrix(scene.static_quats.astype(np.float64)) * scene.static_scales[:, None, :]
    covariances = axes @ axes.transpose(0, 2, 1)
    kept = np.stack([covariances[:, i, j] for i, j in PAIRS], axis=1)
    opacities = scene.opacities[len(scene.opacities) - scene.static_count :, None]
    return np.concatenate([scene.static_means, opacities, kept], axis=1).astype(np.float32)


def unpacked(gaussians: np.ndarray, colors: np.ndarray, count: int) -> Gaussians:
    """The Gaussians that a viewer draws from the outputs: rotations and scales are the axes of the covariances."""
    rows = gaussians[:count].astype(np.float64)
    covariances = np.empty((count, 3, 3))
    for column, (i, j) in enumerate(PAIRS):
        covariances[:, i, j] = covariances[:, j, i] = rows[:, 4 + column]
    squares, axes = np.linalg.eigh(covariances)
    axes[..., 0] *= np.sign(np.linalg.det(axes))[:, None]
    scales = np.sqrt(np.maximum(squares, 0)).clip(1e-9)
    arrays = (rows[:, :3], from_matrix(axes), scales, rows[:, 3], colors[:count].reshape(count, -1, 3))
    return Gaussians(*map(as_float32, arrays))

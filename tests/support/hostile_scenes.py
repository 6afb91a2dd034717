"""Hostile scene files, each made from a valid one, and the expected message."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper, parser

SECRET_BYTES = 24
MANY = 1_500_000_000
"""Count of float32 numbers that take 6 GB."""


class Attack(NamedTuple):
    """A hostile change of a scene file; `on` makes it from a valid model and the path of a secret file."""

    name: str
    message: str
    on: Callable[[onnx.ModelProto, Path], bytes]

    def __str__(self) -> str:
        return self.name


def varint(value: int) -> bytes:
    """Encode a number in protobuf's wire format."""
    digits = bytearray()
    while value >= 0x80:
        digits.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*digits, value])


def field(number: int, content: bytes | int) -> bytes:
    """Encode a field in protobuf's wire format: a number, or bytes with their length."""
    if isinstance(content, int):
        return varint(number << 3) + varint(content)
    return varint(number << 3 | 2) + varint(len(content)) + content


def with_graph(model: onnx.ModelProto, graph: bytes) -> bytes:
    """Return the model with another graph, given as bytes."""
    rest = onnx.ModelProto()
    rest.CopyFrom(model)
    rest.ClearField("graph")
    return rest.SerializeToString() + field(7, graph)


def elsewhere(name: str, secret: Path, location: int = TensorProto.EXTERNAL) -> bytes:
    """Return a tensor [8, 3] whose values are the first bytes of a file; `location` is its `data_location`."""
    tensor = onnx.TensorProto(name=name, data_type=TensorProto.UINT8, dims=[SECRET_BYTES // 3, 3])
    for key, value in {"location": str(secret), "offset": "0", "length": str(SECRET_BYTES)}.items():
        tensor.external_data.add(key=key, value=value)
    return tensor.SerializeToString() + field(14, location)


def constant_elsewhere(secret: Path) -> onnx.NodeProto:
    """Return a node whose output `bytes` is read from a file."""
    value = onnx.TensorProto.FromString(elsewhere("value", secret))
    return helper.make_node("Constant", [], ["bytes"], value=value)


AS_HEIGHTS = helper.make_node("Cast", ["bytes"], ["base"], to=TensorProto.FLOAT)
"""Returns the bytes of the file as positions."""


def without_base(model: onnx.ModelProto) -> onnx.TensorProto:
    """Remove the positions from the model's constants; return them."""
    base = next(each for each in model.graph.initializer if each.name == "base")
    model.graph.initializer.remove(base)
    return base


def put_first(model: onnx.ModelProto, *nodes: onnx.NodeProto) -> None:
    """Put nodes before those of the graph."""
    nodes = (*nodes, *model.graph.node)
    del model.graph.node[:]
    model.graph.node.extend(nodes)


def truncated_location(model: onnx.ModelProto, secret: Path) -> bytes:
    """Truncated to 32 bits, 2³² + 1 is 1: EXTERNAL."""
    without_base(model)
    put_first(model, AS_HEIGHTS)
    return with_graph(model, model.graph.SerializeToString() + field(5, elsewhere("bytes", secret, 2**32 + 1)))


def location_alone(model: onnx.ModelProto, secret: Path) -> bytes:
    """The same number in an otherwise valid file."""
    base = without_base(model).SerializeToString() + field(14, 2**32 + 1)
    return with_graph(model, model.graph.SerializeToString() + field(5, base))


def inside_a_function(model: onnx.ModelProto, secret: Path) -> bytes:
    """The constant lies in a function of the model."""
    without_base(model)
    nodes, opsets = [constant_elsewhere(secret), AS_HEIGHTS], [helper.make_opsetid("", 20)]
    model.functions.append(helper.make_function("local", "Heights", [], ["base"], nodes, opsets))
    model.opset_import.append(helper.make_opsetid("local", 1))
    put_first(model, helper.make_node("Heights", [], ["base"], domain="local"))
    return model.SerializeToString()


def in_a_node(model: onnx.ModelProto, secret: Path) -> bytes:
    """The constant is a node of the graph."""
    without_base(model)
    put_first(model, constant_elsewhere(secret), AS_HEIGHTS)
    return model.SerializeToString()


def with_factor(graph: str, model: onnx.ModelProto, secret: Path, **constants: np.ndarray) -> bytes:
    """Multiply the scene's motion by the output of a graph in ONNX's text format."""
    added = parser.parse_graph(f"added (float[1] t, float[1] one) => (float[1] factor) {graph}")
    constants |= {each.name: numpy_helper.to_array(each) for each in added.initializer}
    model.graph.initializer.extend(numpy_helper.from_array(values, name) for name, values in constants.items())
    domains = {node.domain for node in added.node} - {""}
    model.opset_import.extend(helper.make_opsetid(domain, 1) for domain in domains)
    put_first(model, *added.node)
    next(node for node in model.graph.node if node.output[0] == "applied").input[:] = ["t", "factor"]
    return model.SerializeToString()


def beside_the_scene(nodes: str, **constants: np.ndarray) -> Callable[[onnx.ModelProto, Path], bytes]:
    """Add nodes that compute `largest`; times 0, it is added to the factor of the scene's motion."""
    small = f"int64[1] size = {{{MANY}}}, int64 start = {{0}}, int64 stop = {{{MANY}}}, int64 step = {{1}}"
    small += ", int64[1] first = {0}, int64[1] second = {1}, float[1] nothing = {0}"
    graph = f"<{small}> {{ {nodes} unseen = Mul(largest, nothing) factor = Add(one, unseen) }}"
    return partial(with_factor, graph, **constants)


def six_gigabytes(call: str) -> Attack:
    """Make an array of 6 GB by an operator whose inputs set the size of its output."""
    operator = call.partition("(")[0]
    nodes = f"vast = {call} few = Slice(vast, first, second) largest = Cast <to = 1> (few)"
    return Attack(f"six gigabytes by {operator}", f"the operator {operator}", beside_the_scene(nodes))


# the loop runs 10¹⁵ times around t = 0.5, but not at the ends of the time range
LOOP = """
<float[1] eight = {8}, float[1] huge = {1e15}, int64[0] none = {}, bool go = {1}> {
    rest = Sub(one, t)
    product = Mul(t, rest)
    raised = Mul(product, eight)
    bump = Floor(raised)
    times = Mul(bump, huge)
    many = Cast <to = 7> (times)
    trips = Reshape(many, none)
    factor = Loop <body = body (int64 number, bool on, float[1] state) => (bool on_out, float[1] state_out) {
        on_out = Identity(on)
        state_out = Identity(state)
    }> (trips, go, one)
}
"""
VAST = """
vast = Add(row_now, column)
few = Gather(vast, first)
largest = Gather <axis = 1> (few, first)
"""
"""A column of 40,000 numbers plus `row_now`, which makes 6 GB of as long a row."""
BROADCASTING = f"row_now = Mul(row, t) {VAST}"
SQUEEZING = f"stacked = Mul(rows, t) row_now = Squeeze(stacked, none) {VAST}"
REDUCING = """
stacked = Mul(rows, t)
product = ReduceProd <keepdims = 0> (stacked, none)
largest = Reshape(product, one_number)
"""
SCATTERING = """
before = Reshape(t, one_row)
after = ScatterND(before, rows, updates)
largest = Reshape(after, one_number)
"""
PRODUCTS = f"""
m0 = Mul(square, t)
{" ".join(f"m{i + 1} = MatMul(m{i}, square)" for i in range(60))}
few = Gather(m60, first)
largest = Gather <axis = 1> (few, first)
"""
ATTACKS = (
    Attack("file read by a truncated location", "external_data", truncated_location),
    Attack("location of 33 bits", "data_location", location_alone),
    Attack("file read inside a function", "functions", inside_a_function),
    Attack("constant node in another file", "`t`, which a scene file may not have", in_a_node),
    Attack("loop without end around t = 0.5", "`g`, which a scene file may not have", partial(with_factor, LOOP)),
    six_gigabytes("Expand(one, size)"),
    six_gigabytes("Tile(one, size)"),
    six_gigabytes("ConstantOfShape(size)"),
    six_gigabytes("Range(start, stop, step)"),
    six_gigabytes("Resize(one, , , size)"),
    Attack(
        "six gigabytes by broadcasting",
        "`vast` (Add) brings a frame to 6,104 MiB of values; the limit is 2,048 MiB",
        beside_the_scene(BROADCASTING, row=np.ones((1, 40_000), np.float32), column=np.ones((40_000, 1), np.float32)),
    ),
    Attack(
        "six gigabytes by a squeeze of no axes, which is of all",
        "squeezes axes []",
        beside_the_scene(
            SQUEEZING,
            rows=np.ones((1, 40_000, 1), np.float32),
            column=np.ones((40_000, 1), np.float32),
            none=np.empty(0, np.int64),
        ),
    ),
    Attack(
        "a reduction of no axes, which is of all",
        "reduces no axes",
        beside_the_scene(
            REDUCING, rows=np.ones((1, 8), np.float32), none=np.empty(0, np.int64), one_number=np.ones(1, np.int64)
        ),
    ),
    Attack(
        "one row replaced a million times",
        "replaces 1000000 rows of 1",
        beside_the_scene(
            SCATTERING,
            rows=np.zeros((1_000_000, 1), np.int64),
            updates=np.ones((1_000_000, 1), np.float32),
            one_row=np.ones(2, np.int64),
            one_number=np.ones(1, np.int64),
        ),
    ),
    Attack(
        "a quadrillion operations",
        "(MatMul) brings a call to 2.1e+11 operations; the limit is 2e+11",
        beside_the_scene(PRODUCTS, square=np.eye(2000, dtype=np.float32)),
    ),
    Attack(
        "integers divided by zero, at which processors raise a signal",
        "`quotient` (Div) reads int64, not float32",
        beside_the_scene("whole = Cast <to = 7> (t) quotient = Div(whole, whole) largest = Cast <to = 1> (quotient)"),
    ),
    Attack(
        "a shape that depends on time",
        "`largest` (Reshape) reads `whole`, which must be a constant of the file",
        beside_the_scene("whole = Cast <to = 7> (t) largest = Reshape(one, whole)"),
    ),
    Attack("another domain", "com.microsoft", beside_the_scene("largest = com.microsoft.Gelu(t)")),
)

POISON: dict[str, tuple[str, str]] = {
    "a time of 400 digits": ("time_range", f"[0, 1{'0' * 400}]"),
    "100,000 lists in each other": ("left_out", "[" * 100_000 + "]" * 100_000),
    "an error of 400 digits": ("measured_error", f'{{"rendered": {{"psnr_worst": 1{"0" * 400}}}}}'),
    "an infinite error": ("measured_error", '{"rendered": {"psnr_worst": 1e999}}'),
    "a header in the plan": ("plan", '"network\\r\\nSet-Cookie: a=b"'),
    "a lone surrogate": ("plan", '"\\ud800"'),
    "a plan of 300,000 letters": ("plan", f'"{"x" * 300_000}"'),
    "a key twice": ("measured_error", '{"psnr": 1, "psnr": 2}'),
    "300,000 quotation marks": ("left_out", '"\\"' * 100_000),
    "texts for numbers": ("time_range", '["0", "1"]'),
    "not a number": ("bounds", "[[0, 0, NaN], [1, 1, 1]]"),
}
"""Metadata by their fault: the field and its text."""


def poisoned(model: onnx.ModelProto, what: str) -> bytes:
    """The scene with one entry of `POISON`."""
    name, text = POISON[what]
    properties = {entry.key: entry.value for entry in model.metadata_props} | {name: text}
    del model.metadata_props[:]
    helper.set_model_props(model, properties)
    return model.SerializeToString()

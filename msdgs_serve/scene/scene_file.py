"""Read a scene file from bytes, and check all of it before any part runs."""

import ctypes
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from msdgs_serve.scene.baked import APPEARANCE, OPTIONAL_INPUT, constant_outputs
from msdgs_serve.scene.errors import SceneFileInvalid
from msdgs_serve.scene.foreign import START_BYTES, foreign_file
from msdgs_serve.scene.gaussians import count_non_finite
from msdgs_serve.scene.metadata import CONTRACT, SceneMetadata
from msdgs_serve.scene.onnx import (
    UNLIMITED,
    GraphLimits,
    Model,
    ModelInvalid,
    Tensor,
    Value,
    infer,
    needed,
    read_model,
    write_model,
)
from msdgs_serve.scene.onnx.model import FLOAT, INT64, Port, element_name
from msdgs_serve.scene.onnx.shapes import IDS, Shape, fixed, text
from msdgs_serve.scene.spherical_harmonics import sh_coefficients

CHUNK = 2048
"""Gaussians per call of a graph that runs layers on Gaussians. The largest activation of a call is CHUNK × width."""
PER_ID_FACTOR = 2
"""A graph computes all Gaussians in any case if a call for all of them takes less than this times the operations of a
call for one."""
MAX_PADDING = 4096
"""Rows that poses of all Gaussians may have beyond the Gaussians themselves; a pose that is kept keeps them."""

_INPUTS: Mapping[str, tuple[int, Shape]] = {
    "t": (FLOAT, fixed([1])),
    "ids": (INT64, (IDS,)),
    OPTIONAL_INPUT: (FLOAT, fixed([1])),
}
_MOSTLY = 0.75
"""Part of a file from which its constants stay in its memory."""
_LONG_HEADER = 128
"""Bytes of an array whose length alone takes two bytes in front of it, beside the number of its field."""


@dataclass(frozen=True)
class SceneCost:
    """Upper bounds of a scene's cost, which are known before it runs and hold at all times, and the limits."""

    memory_bytes: int  # of the values of one call and of all poses
    operations: int  # of posing all moving Gaussians once
    calls: int  # of the graph for one pose of all moving Gaussians
    limits: GraphLimits


@dataclass(frozen=True)
class SceneFile:
    """The contents of a scene file. `graph` and `constant_graph` are ONNX models written by this package."""

    metadata: SceneMetadata
    moving_count: int
    steps: float | None  # the default input; None if the plan doesn't run layers
    takes_ids: bool  # whether the graph has the input `ids`
    poses_all: bool  # whether a call computes all Gaussians in any case
    posed: Mapping[str, tuple[int, ...]]  # outputs that depend on time, and the shape of a row of each
    outputs: tuple[str, ...]  # those of `graph` with the values of `posed`
    selected: bool  # whether rows of the outputs are those of the input `ids`; otherwise row i is of Gaussian i
    constants: Mapping[str, np.ndarray]  # those of `constant_outputs` that are stored directly; unaligned views
    graph: bytes  # computes `outputs` from the inputs of the contract, which have no defaults
    constant_graph: bytes | None  # computes the remaining `constant_outputs`, without inputs
    cost: SceneCost

    @property
    def changing(self) -> tuple[str, ...]:
        """Opacities and SH, if they depend on time."""
        return tuple(name for name in self.posed if name in APPEARANCE)

    def aligned_constants(self, contents: memoryview) -> dict[str, np.ndarray]:
        """Return the constants in aligned memory. If they are most of a file whose contents may be overwritten, this is
        theirs, and nothing else may be read from it then; otherwise copies, which don't keep the file in memory."""
        size = sum(array.nbytes for array in self.constants.values())
        if contents.readonly or size < _MOSTLY * len(contents):
            return {name: array.copy() for name, array in self.constants.items()}
        return {name: _moved(array, contents) for name, array in self.constants.items()}

    @property
    def computed(self) -> list[str]:
        """Names of the outputs of `constant_graph`."""
        return [name for name in constant_outputs(self.changing) if name not in self.constants]


def read_scene_file(contents: bytes | memoryview, file: str, limits: GraphLimits) -> SceneFile:
    """Read and check a scene file. Raises `SceneFileInvalid` naming `file` and the field, node or constant."""
    if not len(contents):
        raise SceneFileInvalid(file, "file", "is empty")
    try:
        model = read_model(contents)
        metadata = SceneMetadata.from_properties(model.properties, file)
        return _read(model, metadata, limits)
    except ModelInvalid as error:
        if other := foreign_file(bytes(contents[:START_BYTES]), file):
            raise SceneFileInvalid(file, "file", other) from None
        raise SceneFileInvalid(file, error.field, error.problem) from None


def _read(model: Model, metadata: SceneMetadata, limits: GraphLimits) -> SceneFile:
    for tensor in model.constants.values():
        _check_finite(tensor)
    inputs = _inputs(model)
    takes_ids = "ids" in inputs
    moving_count, steps = _default_ids(model) if takes_ids else _rows(model), _default_steps(model)
    posed = _posed(model, metadata)
    returned = moving_count * sum(4 * math.prod(row) for row in posed.values())
    poses_all = not takes_ids or steps is None or _poses_all(model, inputs, moving_count)
    ids = moving_count if poses_all else min(CHUNK, moving_count)
    calls = -(-moving_count // max(ids, 1))
    values, cost = infer(model, inputs, limits, ids, calls, returned)
    constant = constant_outputs(posed)
    _check_outputs(model, values, moving_count, takes_ids, posed, constant)
    _check_count(moving_count + values["static_means"].shape[0].fixed, limits)
    constants = {}
    for name in constant:
        stored = values[name].constant
        if stored is not None:
            constants[name] = stored.array()
    computed = [name for name in constant if name not in constants]
    rows = _before_selection(model, values, moving_count, tuple(posed)) if poses_all else None
    outputs = rows or tuple(posed)
    return SceneFile(
        metadata,
        moving_count,
        steps,
        takes_ids,
        poses_all,
        posed,
        outputs,
        rows is None,
        constants,
        write_model(model, outputs, inputs, values),
        write_model(model, computed, {}, values) if computed else None,
        SceneCost(cost.memory_bytes, cost.operations * calls, calls, limits),
    )


def _poses_all(model: Model, inputs: Mapping[str, Value], moving_count: int) -> bool:
    """Whether all Gaussians take hardly more operations than one."""
    one, every = (infer(model, inputs, UNLIMITED, ids, 1, 0)[1].operations for ids in (1, moving_count))
    return every < PER_ID_FACTOR * one


def _before_selection(
    model: Model, values: Mapping[str, Value], moving_count: int, names: tuple[str, ...]
) -> tuple[str, ...] | None:
    """The names of the poses of all Gaussians, row i of Gaussian i, from which the last nodes of a graph select the
    ids, or the first rows. None if it has the input `ids` and its last nodes do something else.

    The selection takes 2.5 of 10.7 ms of a pose of 106,500 Gaussians on one thread, and usually selects all in order.
    """
    if not moving_count:
        return None
    makers, rows = {node.outputs[0]: node for node in model.nodes}, []
    takes_ids = "ids" in model.inputs
    otherwise, operator = (None, "Gather") if takes_ids else (names, "Split")
    for name in names:
        node = makers.get(name)
        if node is None or node.operator != operator or node.attributes.get("axis", 0):
            return otherwise
        if takes_ids and node.inputs[1] != "ids":
            return otherwise
        value = values[node.inputs[0]]
        rows_range = range(moving_count, moving_count + MAX_PADDING + 1)
        if not value.varies or value.shape[0].per_id or value.shape[0].fixed not in rows_range:
            return otherwise
        rows.append(node.inputs[0])
    if len({*rows}) < len(rows) or (takes_ids and "ids" in needed(model, rows)[1]):
        return otherwise
    return tuple(rows)


def _moved(array: np.ndarray, contents: memoryview) -> np.ndarray:
    """Return an array of `contents`, moved to the next aligned place before it, over a part of its own header."""
    whole = np.frombuffer(contents, np.uint8)
    place = array.ctypes.data - whole.ctypes.data
    shift = array.ctypes.data % array.itemsize
    if not shift or array.nbytes < _LONG_HEADER:
        return array if not shift else array.copy()
    ctypes.memmove(array.ctypes.data - shift, array.ctypes.data, array.nbytes)
    return whole[place - shift :][: array.nbytes].view(array.dtype).reshape(array.shape)


def _check_finite(tensor: Tensor) -> None:
    if tensor.element != FLOAT:
        return
    if bad := count_non_finite(tensor.array()):
        raise ModelInvalid(tensor.name, f"holds {bad:,} values that are NaN or infinite")


def _inputs(model: Model) -> dict[str, Value]:
    if "t" not in model.inputs:
        raise ModelInvalid("t", "is missing from the inputs")
    if "t" in model.constants:
        raise ModelInvalid("t", "has a default value; only `ids` and `steps` may have one")
    for name, port in model.inputs.items():
        if name not in _INPUTS:
            raise ModelInvalid(name, "isn't an input of this contract")
        element, shape = _INPUTS[name]
        if port.element != element:
            raise ModelInvalid(name, f"is {element_name(port.element)}, not {element_name(element)}")
        if not _is_of_shape(port, shape):
            raise ModelInvalid(name, f"has shape {port.shape}, not {text(shape)}")
    return {name: Value(*_INPUTS[name], varies=True) for name in _INPUTS if name in model.inputs}


def _is_of_shape(port: Port, shape: Shape) -> bool:
    """Whether a port has a shape; dimensions without a number match any."""
    if port.shape is None:
        return True
    if len(port.shape) != len(shape):
        return False
    return all(
        isinstance(given, str) or (given == dim.fixed and not dim.per_id)
        for given, dim in zip(port.shape, shape, strict=True)
    )


def _rows(model: Model) -> int:
    """The number of rows that `means` is declared to have, in a graph without `ids`."""
    means = model.outputs.get("means")
    rows = None if means is None else (means.shape or (None,))[0]
    if not isinstance(rows, int) or rows < 0:
        raise ModelInvalid("ids", "is missing from the inputs, and `means` has no fixed number of rows")
    return rows


def _default_ids(model: Model) -> int:
    ids = model.constants.get("ids")
    if ids is None:
        raise ModelInvalid("ids", "has no default value, which must be all moving Gaussians")
    if ids.element != INT64 or len(ids.shape) != 1 or not np.array_equal(ids.array(), np.arange(ids.shape[0])):
        raise ModelInvalid("ids", "has a default value that isn't all moving Gaussians in order")
    return ids.shape[0]


def _default_steps(model: Model) -> float | None:
    if OPTIONAL_INPUT not in model.inputs:
        return None
    steps = model.constants.get(OPTIONAL_INPUT)
    if steps is None:
        raise ModelInvalid(OPTIONAL_INPUT, "has no default value, which must be the number of layers")
    if steps.element != FLOAT or steps.shape != (1,):
        raise ModelInvalid(OPTIONAL_INPUT, "has a default value that isn't one float32")
    return float(steps.array()[0])


def _check_count(gaussians: int, limits: GraphLimits) -> None:
    if gaussians > limits.gaussians:
        raise ModelInvalid("ids", f"and `static_means` are {gaussians:,} Gaussians; the limit is {limits.gaussians:,}")


def _posed(model: Model, metadata: SceneMetadata) -> dict[str, tuple[int, ...]]:
    """The outputs that depend on time, and the shape of a row of each."""
    posed: dict[str, tuple[int, ...]] = {"means": (3,), "quats": (4,), "scales": (3,)}
    if metadata.contract != CONTRACT:
        appearance = {"opacities": (), "sh": (sh_coefficients(metadata.sh_degree), 3)}
        posed |= {name: row for name, row in appearance.items() if f"static_{name}" in model.outputs}
    return posed


def _check_outputs(
    model: Model,
    values: Mapping[str, Value],
    moving_count: int,
    takes_ids: bool,
    posed: Mapping[str, tuple[int, ...]],
    constant: tuple[str, ...],
) -> None:
    for name in (*posed, *constant):
        if name not in model.outputs or name not in values:
            raise ModelInvalid(name, "is missing from the outputs")
        declared, element = model.outputs[name].element, values[name].element
        if (declared, element) != (FLOAT, FLOAT):
            wrong = declared if declared != FLOAT else element
            raise ModelInvalid(name, f"is {element_name(wrong)}, not float32")
    for name in constant:
        if values[name].varies:
            raise ModelInvalid(name, "depends on an input, but must be constant")
        if not values[name].shape:
            raise ModelInvalid(name, "is a single number")
    for name, row in posed.items():
        every = fixed([moving_count, *row])
        shapes = [every] if not takes_ids else [(IDS, *fixed(row))] + ([] if moving_count else [every])
        if values[name].shape not in shapes:
            raise ModelInvalid(name, f"has shape {text(values[name].shape)}, not {text(shapes[0])}")

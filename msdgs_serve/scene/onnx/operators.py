"""The table of operators that scene files may contain. A plan that needs another adds a row here and in
docs/contract.md.

Output shapes don't depend on computed values: shapes, axes and lengths are constants of the file. There is no integer
division, and indices of replaced rows are constants, as errors in them would crash.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import permutations

from msdgs_serve.scene.onnx import rules
from msdgs_serve.scene.onnx.model import BOOL, FLOAT, INT8, INT16, INT32, INT64, UINT8, Attribute
from msdgs_serve.scene.onnx.rules import Call, Result

FUNCTION = 16
"""Operations that a transcendental function counts as."""


@dataclass(frozen=True)
class Operand:
    """An input of an operator: its element types, and whether it must be a constant of the file."""

    elements: tuple[int, ...]
    constant: bool = False


@dataclass(frozen=True)
class Operator:
    """A row of the table. The element type of results is `result`, or that in the attribute `result`, or else that of
    the input `like`."""

    operands: tuple[Operand, ...]
    rule: Callable[[Call], Result] = rules.elementwise
    attributes: Mapping[str, tuple[Attribute, ...]] = field(default_factory=dict)  # allowed values by attribute
    needed: tuple[str, ...] = ()  # required attributes
    result: int | str | None = None
    like: int = 0
    repeated: bool = False  # whether the last operand may be repeated
    work: int = 1  # operations per element of the result


_FLOAT = Operand((FLOAT,))
_NUMBER = Operand((FLOAT, INT64))
_ANY = Operand((FLOAT, UINT8, INT8, INT16, INT32, INT64))
_FACTOR = Operand((FLOAT,), constant=True)
_LENGTHS = Operand((INT64,), constant=True)
_AXES = tuple(range(-3, 4))
_AXIS = {"axis": _AXES}


def _function(work: int = FUNCTION) -> Operator:
    return Operator((_FLOAT,), rules.alike, work=work)


OPERATORS: Mapping[str, Operator] = {
    "Add": Operator((_NUMBER, _NUMBER)),
    "Cast": Operator(
        (Operand((FLOAT, UINT8, INT16, INT32, INT64, BOOL)),), rules.alike, {"to": (FLOAT, INT64)}, ("to",), "to"
    ),
    "Clip": Operator((_FLOAT, _FLOAT, _FLOAT), rules.clip),
    "Concat": Operator((_FLOAT,), rules.concat, _AXIS, ("axis",), repeated=True),
    "Cos": _function(),
    "DequantizeLinear": Operator(
        (
            Operand((UINT8, INT8, INT32)),
            _FACTOR,
            Operand((UINT8, INT8, INT32), constant=True),
        ),
        rules.quantize,
        _AXIS,
        result=FLOAT,
    ),
    "Div": Operator((_FLOAT, _FLOAT)),
    "Equal": Operator((Operand((INT64,)), Operand((INT64,))), result=BOOL),
    "Exp": _function(),
    "Floor": _function(1),
    "Gather": Operator((_ANY, Operand((INT64,))), rules.gather, _AXIS),
    "Gemm": Operator((_FLOAT, _FLOAT, _FLOAT), rules.gemm, {"transB": (0, 1)}),
    "Identity": Operator((_ANY,), rules.alike),
    "Less": Operator((_FLOAT, _FLOAT), result=BOOL),
    "Log": _function(),
    "MatMul": Operator((_FLOAT, _FLOAT), rules.matmul),
    "Max": Operator((_FLOAT, _FLOAT)),
    "Min": Operator((_FLOAT, _FLOAT)),
    "Mul": Operator((_NUMBER, _NUMBER)),
    "Pow": Operator((_FLOAT, _FLOAT), work=FUNCTION),
    "QuantizeLinear": Operator((_FLOAT, _FACTOR, Operand((UINT8, INT8), constant=True)), rules.quantize, like=2),
    "ReduceProd": Operator((_FLOAT, _LENGTHS), rules.reduce, {"keepdims": (0, 1)}),
    "Relu": _function(1),
    "Reshape": Operator((_NUMBER, _LENGTHS), rules.reshape),
    "ScatterND": Operator((_FLOAT, _LENGTHS, _FLOAT), rules.scatter),
    "Sigmoid": _function(),
    "Sin": _function(),
    "Split": Operator((_FLOAT, _LENGTHS), rules.split, _AXIS),
    "Sqrt": _function(1),
    "Squeeze": Operator((_FLOAT, _LENGTHS), rules.squeeze),
    "Sub": Operator((_FLOAT, _FLOAT)),
    "Transpose": Operator((_FLOAT,), rules.transpose, {"perm": tuple(permutations(range(3)))}, ("perm",)),
    "Unsqueeze": Operator((Operand((FLOAT, BOOL)), _LENGTHS), rules.unsqueeze),
    "Where": Operator((Operand((BOOL,)), _FLOAT, _FLOAT), like=1),
}

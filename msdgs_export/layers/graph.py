"""A small builder of ONNX graphs of named constants and nodes."""

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper

from msdgs_serve.scene.errors import InvalidInput

OPSET = 18
IR_VERSION = 9
"""The version of opset 18, which every onnxruntime since 1.14 reads."""

MAX_BYTES = (1 << 31) - (1 << 20)
"""Of the arrays of a file, which holds 2 GiB at most, with nodes and metadata."""

Parameter = torch.Tensor | torch.nn.Module  # torch types every attribute of a module as either


class GraphBuilder:
    """Collects nodes in the order of execution."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: dict[str, onnx.TensorProto] = {}

    def constant(self, name: str, values: np.ndarray) -> str:
        """Store an array under `name`; returns the name. Raises `ValueError` if it holds another array."""
        tensor = numpy_helper.from_array(np.ascontiguousarray(values), name)
        if self.constants.setdefault(name, tensor) != tensor:
            raise ValueError(f"two constants named {name}")
        return name

    def node(self, operator: str, inputs: list[str], output: str, **attributes: Any) -> str:
        """Add a node of one output; returns the output's name."""
        self.nodes.append(helper.make_node(operator, inputs, [output], name=output, **attributes))
        return output

    def split(self, value: str, outputs: list[str], sizes: list[int], axis: int = 1) -> list[str]:
        """Split a matrix into groups of columns, or of rows, with these sizes."""
        lengths = self.constant(f"{value}.sizes", np.array(sizes, np.int64))
        self.nodes.append(helper.make_node("Split", [value, lengths], outputs, name=f"{value}.split", axis=axis))
        return outputs

    def model(
        self,
        inputs: Mapping[str, tuple[int, Sequence[int | str]]],
        outputs: Mapping[str, Sequence[int | str]],
        properties: dict[str, str],
        *,
        types: Mapping[str, int] = MappingProxyType({}),
        name: str = "msdgs",
        opset: int = OPSET,
        ir_version: int = IR_VERSION,
    ) -> onnx.ModelProto:
        """The checked model; inputs with type and shape, outputs with shape by name, float32 but for `types`.

        Raises `InvalidInput` if its constants don't fit into a file.
        """
        size = sum(math.prod(each.dims) * _itemsize(each) for each in self.constants.values())
        if size > MAX_BYTES:
            fits = "small enough for an ONNX file, which holds at most 2 GiB"
            raise InvalidInput("model", fits, f"{size / 2**30:.2f} GiB of arrays")
        graph = helper.make_graph(
            self.nodes,
            name,
            [helper.make_tensor_value_info(each, *kind) for each, kind in inputs.items()],
            [helper.make_tensor_value_info(n, types.get(n, TensorProto.FLOAT), shape) for n, shape in outputs.items()],
            list(self.constants.values()),
        )
        model = helper.make_model(
            graph, opset_imports=[helper.make_opsetid("", opset)], ir_version=ir_version, producer_name="msdgs"
        )
        helper.set_model_props(model, properties)
        onnx.checker.check_model(model)
        return model


def affine(graph: GraphBuilder, name: str, value: str, weight: Parameter, bias: Parameter) -> str:
    """Rows times a Linear's weight, plus its bias."""
    constants = [graph.constant(f"{name}.{kind}", to_numpy(v)) for kind, v in (("weight", weight), ("bias", bias))]
    return graph.node("Gemm", [value, *constants], f"{name}.out", transB=1)


def _itemsize(tensor: onnx.TensorProto) -> int:
    return helper.tensor_dtype_to_np_dtype(tensor.data_type).itemsize


def to_numpy(tensor: Parameter) -> np.ndarray:
    """A parameter or buffer as contiguous float32."""
    assert isinstance(tensor, torch.Tensor)
    return np.ascontiguousarray(tensor.detach().to("cpu", torch.float32).numpy())

"""ONNX models of scene files: strict reading, cost limits and writing. Depends on NumPy only.

`read_model` parses the file, `infer` computes types, shapes and cost of all values, and `write_model` writes the needed
part of the graph as a new model, which is all that onnxruntime reads.
"""

from msdgs_serve.scene.onnx.cost import UNLIMITED, CallCost, GraphLimits
from msdgs_serve.scene.onnx.infer import Value, infer
from msdgs_serve.scene.onnx.model import Model, Node, Port, Tensor, read_model
from msdgs_serve.scene.onnx.wire import ModelInvalid
from msdgs_serve.scene.onnx.write import needed, write_model

__all__ = [
    "UNLIMITED",
    "CallCost",
    "GraphLimits",
    "Model",
    "ModelInvalid",
    "Node",
    "Port",
    "Tensor",
    "Value",
    "infer",
    "needed",
    "read_model",
    "write_model",
]

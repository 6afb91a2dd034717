"""ONNX models as scene files have them: read strictly, bounded in cost, and written again. NumPy only.

`read_model` takes bytes apart, `infer` says what each value is and what a call costs, `write_model` puts what is needed
of it into new bytes, which are all that onnxruntime ever gets.
"""

from msdgs_serve.scene.onnx.cost import UNLIMITED, CallCost, GraphLimits
from msdgs_serve.scene.onnx.infer import Value, infer
from msdgs_serve.scene.onnx.model import Model, Node, Port, Tensor, read_model
from msdgs_serve.scene.onnx.wire import ModelInvalid
from msdgs_serve.scene.onnx.write import write_model

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
    "read_model",
    "write_model",
]

"""A layer of kind `mlp` as a graph: encodings and matrix products."""

import copy
from typing import cast

import numpy as np
import torch

from msdgs_export.layers.base import HEAD_COLUMNS, FieldLayerExport, LayerInputs, heads_of, zero
from msdgs_export.layers.graph import GraphBuilder, affine, to_numpy
from msdgs_train.layers.base import DeformationLayer
from msdgs_train.layers.mlp import MLPLayer


class MLPExport(FieldLayerExport):
    """Exports `MLPLayer`."""

    def outputs(self, graph: GraphBuilder, inputs: LayerInputs, rows: np.ndarray) -> str:
        """Encoded means and time through the hidden layers, then one product for all heads."""
        name, layer = inputs.name, cast(MLPLayer, inputs.layer)
        encoded = _encode(graph, f"{name}.xyz", inputs.means, layer.xyz_frequency_matrix)
        code = _time_code(graph, name, layer, inputs.time)
        hidden = _read_input(graph, f"{name}.first", layer, layer.first, encoded, code)
        hidden = graph.node("Relu", [hidden], f"{name}.first.relu")
        for i, linear in enumerate(layer.trunk):
            trunk = f"{name}.trunk{i}"
            if i + 1 == layer.skip:
                read = _read_input(graph, trunk, layer, linear, encoded, code)
                weight = graph.constant(f"{trunk}.weight", to_numpy(linear.weight)[:, layer.input_features :])
                out = graph.node("Gemm", [hidden, weight, read], f"{trunk}.out", transB=1)
            else:
                out = affine(graph, trunk, hidden, linear.weight, linear.bias)
            hidden = graph.node("Relu", [out], f"{trunk}.relu")
        return affine(graph, f"{name}.heads", hidden, layer.heads.weight[rows], layer.heads.bias[rows])

    def inert_heads(self, layer: DeformationLayer) -> frozenset[str]:
        """Heads whose rows of the last Linear are all 0."""
        heads, columns = cast(MLPLayer, layer).heads, heads_of(layer).columns
        return frozenset(n for n, rows in columns.items() if not (heads.weight[rows].any() or heads.bias[rows].any()))

    def without_heads(self, layer: DeformationLayer, names: frozenset[str]) -> DeformationLayer:
        """Set these rows of the last Linear to 0."""
        layer = copy.deepcopy(cast(MLPLayer, layer))
        for name in names:
            zero(layer.heads.weight[HEAD_COLUMNS[name]], layer.heads.bias[HEAD_COLUMNS[name]])
        return layer


def _time_code(graph: GraphBuilder, name: str, layer: MLPLayer, time: str) -> str:
    """[1, time_features] the encoded time: one row per call, for any number of ids."""
    encoded = _encode(graph, f"{name}.time", time, layer.time_frequency_matrix)
    hidden = affine(graph, f"{name}.time_hidden", encoded, layer.time_hidden.weight, layer.time_hidden.bias)
    hidden = graph.node("Relu", [hidden], f"{name}.time_relu")
    return affine(graph, f"{name}.time_output", hidden, layer.time_output.weight, layer.time_output.bias)


def _read_input(
    graph: GraphBuilder, name: str, layer: MLPLayer, linear: torch.nn.Module, encoded: str, code: str
) -> str:
    """[M, width] the part of a Linear that reads encoded means and time; time is a bias of one row per call."""
    weight = to_numpy(linear.weight)
    weight_time = graph.constant(f"{name}.weight_time", weight[:, layer.xyz_features : layer.input_features])
    bias = graph.constant(f"{name}.bias", to_numpy(linear.bias))
    time_bias = graph.node("Gemm", [code, weight_time, bias], f"{name}.time_bias", transB=1)
    weight_xyz = graph.constant(f"{name}.weight_xyz", weight[:, : layer.xyz_features])
    return graph.node("Gemm", [encoded, weight_xyz, time_bias], f"{name}.read", transB=1)


def _encode(graph: GraphBuilder, name: str, value: str, frequency_matrix: torch.Tensor) -> str:
    """Positional encoding: value, sines and cosines side by side."""
    phases = graph.node(
        "MatMul", [value, graph.constant(f"{name}.frequencies", to_numpy(frequency_matrix))], f"{name}.phases"
    )
    sines = graph.node("Sin", [phases], f"{name}.sines")
    cosines = graph.node("Cos", [phases], f"{name}.cosines")
    return graph.node("Concat", [value, sines, cosines], f"{name}.encoded", axis=1)

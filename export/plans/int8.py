"""Plan `int8`: the network with its widest matrix products in 8 bits, by onnxruntime's static quantizer.

Weights have a scale per output, activations one per product, calibrated on the scene's own Gaussians and times.
Encodings, the first product, which reads them, the heads and everything that depends only on time stay float32.
"""

import logging
import tempfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
from onnx import numpy_helper
from onnxruntime.quantization import CalibrationDataReader, CalibrationMethod, QuantFormat, QuantType, quantize_static

from export.jobs.bake import Baked
from export.measure.verify import times_to_verify
from export.plans.base import Plan
from export.plans.network import network
from msdgs_serve.scene.errors import InvalidInput

TIMES, GAUSSIANS = 16, 2048
"""Sizes of the calibration data."""


def int8(baked: Baked) -> onnx.ModelProto:
    """The scene with all layers, products of width × width in 8 bits. Raises `InvalidInput` if there are none."""
    exact = network(baked, "int8")
    products = [node.name for node in exact.graph.node if node.op_type == "Gemm" and ".trunk" in node.name]
    if not products:
        raise InvalidInput("plan", "any but int8: no layer of this model has a product of width × width", "int8")
    with tempfile.TemporaryDirectory() as folder, _quiet():
        path = Path(folder) / "int8.onnx"
        quantize_static(
            exact,
            path,
            _Calibration(baked, [given.name for given in exact.graph.input]),
            quant_format=QuantFormat.QDQ,
            nodes_to_quantize=products,
            per_channel=True,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
            calibrate_method=CalibrationMethod.MinMax,
        )
        quantized = onnx.load(path)
    return _plain(quantized, exact)


def _plain(model: onnx.ModelProto, exact: onnx.ModelProto) -> onnx.ModelProto:
    """Store all constants as raw bytes and the metadata of `exact` alone, as scene files require; the quantizer writes
    lists of numbers and adds an entry that isn't JSON."""
    for constant in model.graph.initializer:
        constant.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(constant), constant.name))
    del model.metadata_props[:]
    model.metadata_props.extend(exact.metadata_props)
    return model


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress recommendations of onnxruntime that don't apply to this graph."""
    logging.disable(logging.WARNING)
    onnxruntime.set_default_logger_severity(3)
    try:
        yield
    finally:
        logging.disable(logging.NOTSET)
        onnxruntime.set_default_logger_severity(2)


class _Calibration(CalibrationDataReader):
    """Inputs of the network, those of `names`: evenly spread Gaussians, others at each time."""

    def __init__(self, baked: Baked, names: Collection[str]) -> None:
        each = self._each(len(baked.moving), baked.scene.metadata.time_range)
        self._inputs = ({name: given[name] for name in given if name in names} for given in each)

    def get_next(self) -> dict[str, Any] | None:  # type: ignore[override]
        return next(self._inputs, None)

    @staticmethod
    def _each(count: int, time_range: tuple[float, float]) -> Iterator[dict[str, Any]]:
        stride = max(1, count // GAUSSIANS)
        for i, t in enumerate(times_to_verify(*time_range, TIMES)):
            yield {"t": np.array([t], np.float32), "ids": np.arange(i % stride, count, stride, dtype=np.int64)}


INT8 = Plan(
    "int8", "int8", "#ff725c", lambda baked, spec, sample: int8(baked), candidates=lambda layers: ["int8"], speedup=3.8
)

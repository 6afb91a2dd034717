"""Serve dynamic Gaussian scenes from one ONNX file, on a CPU. Importing this package imports nothing heavy."""

import os

os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
"""onnxruntime reads it when it is imported; without it, importing writes a database into the home folder."""

__version__ = "0.2.0"

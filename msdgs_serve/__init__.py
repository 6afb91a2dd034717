"""Serve dynamic Gaussian scenes from one ONNX file, on a CPU. Importing this package imports nothing heavy."""

import os

os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
"""Read by onnxruntime when it is imported; otherwise it writes a database into the home folder."""

__version__ = "0.2.0"

"""Serve dynamic Gaussian scenes from one ONNX file, on a CPU. Importing this package imports nothing heavy."""

__version__ = "0.2.0"

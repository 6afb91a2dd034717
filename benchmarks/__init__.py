"""Measurements; `python -m benchmarks.NAME --help` describes each. Tests don't import them."""

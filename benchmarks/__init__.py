"""Measurements: `python -m benchmarks.PACKAGE.MODULE --help` describes each. Tests don't import them."""

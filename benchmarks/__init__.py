"""Measurements: `python -m benchmarks.NAME --help` says what each tells. Tests import none of this."""

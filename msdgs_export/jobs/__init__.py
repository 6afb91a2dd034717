"""The export of a model file: candidates, the sweep over them, its report, and the written scene file."""

"""From a model file to a scene file: candidates, the sweep over them, and its report."""

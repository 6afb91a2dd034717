"""Deformation layers, one kind per file; each predicts deltas from canonical positions and time."""

"""Errors of exported frames and poses against the model's own, and time and memory of a frame."""

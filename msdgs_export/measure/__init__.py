"""Errors of exported frames and poses against the model's own, and their amplification by layers."""

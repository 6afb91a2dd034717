"""Photometric losses and regularizers."""

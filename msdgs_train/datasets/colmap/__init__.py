"""Colmap."""

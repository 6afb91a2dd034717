"""Metrics of renderings on held-out images, as numbers, tables and contact sheets."""

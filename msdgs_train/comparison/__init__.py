"""Comparison of systems: each on each scene with each seed under one budget, as a table and two plots."""

"""Readers and data structures that several dataset formats share."""

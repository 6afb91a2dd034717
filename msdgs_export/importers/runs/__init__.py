"""Folders of other trainers' runs, one module a trainer."""

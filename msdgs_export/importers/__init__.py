"""Importers of scenes from other programs, one module per format.

All readers treat their input as hostile: sizes are checked before memory is allocated, no code in a file is run, and
errors name the file.
"""

"""COLMAP layout: sparse models in binary or text form, and their images."""

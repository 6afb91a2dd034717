"""Exporters to formats of other viewers, one module a format; `round_trip` reads files back and compares them."""

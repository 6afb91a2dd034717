"""Imports and exports: `imported_formats`, `nodes`, `paper_sized`, `scene_file`."""

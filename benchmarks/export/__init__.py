"""Imports and exports: `imported_formats`, `large_import`, `nodes`, `paper_sized`, `scene_file`."""

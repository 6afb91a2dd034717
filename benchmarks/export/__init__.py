"""Imports and exports: `imported_formats`, `splat_transform`, `paper_sized`."""

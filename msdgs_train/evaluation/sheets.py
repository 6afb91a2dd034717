"""Sheets of images with captions, without resampling."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.writing import replacing

DPI = 100
MARGIN = 12  # pixels, around the sheet and between panels
HEADER = 36
CAPTION = 20
MIN_CELL = 240  # pixels of width, so that a caption fits
MAX_SIDE = 2**16 - 1  # matplotlib's own limit


class Panel(NamedTuple):
    """One image of a sheet."""

    pixels: np.ndarray  # [H, W, 3] uint8, not resampled
    caption: str


def check_sheet(field: str, path: Path) -> None:
    """Create the folder of a sheet. Raises `InvalidInput` naming `field` unless it is a PNG."""
    if path.suffix.lower() != ".png":
        raise InvalidInput(field, "a .png file", path)
    path.parent.mkdir(parents=True, exist_ok=True)


def draw_sheet(path: Path, title: str, rows: list[list[Panel]]) -> None:
    """Write a PNG of `rows` of panels with a caption above each. Atomic.

    Raises `InvalidInput` if the sheet would be too large.
    """
    width, height = sheet_size(rows)
    if max(width, height) > MAX_SIDE:
        raise InvalidInput("size", f"smaller: a sheet has at most {MAX_SIDE:,} pixels a side", f"{width}×{height}")
    figure = Figure(figsize=((width + 0.5) / DPI, (height + 0.5) / DPI), dpi=DPI, facecolor="white")
    figure.text(MARGIN / width, 1 - MARGIN / height, title, va="top", fontsize=11, weight="bold")
    for row, corners in zip(rows, panel_corners(rows), strict=True):
        for panel, (x, y) in zip(row, corners, strict=True):
            figure.text(x / width, 1 - (y - 5) / height, panel.caption, fontsize=9)
            figure.figimage(panel.pixels, x, height - y - len(panel.pixels))
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=DPI)


def panel_corners(rows: list[list[Panel]]) -> list[list[tuple[int, int]]]:
    """Return (x, y) of the top left pixel of each panel."""
    cell = _cell_width(rows)
    corners, y = [], HEADER
    for row in rows:
        y += CAPTION
        corners.append([(MARGIN + column * (cell + MARGIN), y) for column in range(len(row))])
        y += max(len(panel.pixels) for panel in row) + MARGIN
    return corners


def sheet_size(rows: list[list[Panel]]) -> tuple[int, int]:
    """Return width and height of the sheet in pixels."""
    width = MARGIN + max(len(row) for row in rows) * (_cell_width(rows) + MARGIN)
    return width, panel_corners(rows)[-1][0][1] + max(len(panel.pixels) for panel in rows[-1]) + MARGIN


def _cell_width(rows: list[list[Panel]]) -> int:
    return max(MIN_CELL, *(panel.pixels.shape[1] for row in rows for panel in row))

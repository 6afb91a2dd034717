"""SuperSplat's compressed PLY: positions 11-10-11 bits and scales within ranges of 256 Gaussians, colors and opacities
8 bits each."""

from itertools import repeat
from pathlib import Path

import numpy as np

from msdgs_export.importers.errors import ImportFailed
from msdgs_export.importers.splats.base import ROWS, Splats, Stored, smallest_three, splats
from msdgs_export.importers.splats.ply_columns import Columns, rest_of
from msdgs_serve.scene.spherical_harmonics import SH_C0

CHUNK = 256
"""Gaussians that share the ranges of one row of `chunk`."""

ELEVEN = ((21, 11), (11, 10), (0, 11))


def compressed(file: Path, vertex: Columns, chunk: Columns | None, bands: Columns | None) -> Splats:
    """The Gaussians of the elements `vertex`, `chunk` and `sh`.

    A range may be infinite, as SuperSplat writes the lower end of scales of 0: they become the smallest.
    """
    if chunk is None:
        raise ImportFailed(file, "is a compressed PLY without its element `chunk`")
    if chunk.rows * CHUNK < vertex.rows:
        raise ImportFailed(file, f"has {chunk.rows:,} rows of `chunk` for {vertex.rows:,} Gaussians")
    if bands is not None and bands.rows != vertex.rows:
        raise ImportFailed(file, f"has {bands.rows:,} rows of `sh` for {vertex.rows:,} Gaussians")
    rests = repeat(None) if bands is None else bands.parts(ROWS)
    parts = zip(vertex.parts(ROWS), chunk.parts(ROWS // CHUNK), rests, strict=False)  # there may be more chunks
    return splats(file, vertex.rows, (_stored(file, *part) for part in parts))


def _stored(file: Path, vertex: Columns, chunk: Columns, bands: Columns | None) -> Stored:
    of = np.arange(vertex.rows) // CHUNK

    def within(low: str, high: str, parts: np.ndarray) -> np.ndarray:
        first, last = (chunk.named(*(f"{end}{axis}" for axis in low[-3:]))[of] for end in (low[:-3], high[:-3]))
        with np.errstate(invalid="ignore"):  # 0 · ∞ is NaN: such a Gaussian is dropped and counted
            return first * (1 - parts) + last * parts

    colors = _bits(vertex.packed("packed_color"), (24, 8), (16, 8), (8, 8), (0, 8))
    rgb = within("min_rgb", "max_rgb", colors[:, :3]) if chunk.has("min_r") else colors[:, :3]
    packed = vertex.packed("packed_rotation")
    small = (_bits(packed, (20, 10), (10, 10), (0, 10)) - 0.5) * np.sqrt(2)
    sh = ((rgb - 0.5) / SH_C0)[:, None]
    if bands is not None:
        sh = np.concatenate([sh, rest_of(file, bands, lambda name: _byte_sh(bands.read(name)))], axis=1)
    return Stored(
        within("min_xyz", "max_xyz", _bits(vertex.packed("packed_position"), *ELEVEN)),
        within("min_scale_xyz", "max_scale_xyz", _bits(vertex.packed("packed_scale"), *ELEVEN)),
        smallest_three(small, packed >> 30),
        colors[:, 3],
        sh,
    )


def _bits(packed: np.ndarray, *fields: tuple[int, int]) -> np.ndarray:
    """[N, F] values in [0, 1] of fields given as (first bit, number of bits)."""
    return np.stack([((packed >> first) & (2**size - 1)) / (2**size - 1) for first, size in fields], axis=1)


def _byte_sh(stored: np.ndarray) -> np.ndarray:
    parts = np.where(stored <= 0, 0, np.where(stored >= 255, 1, (stored + 0.5) / 256))
    return (parts - 0.5) * 8

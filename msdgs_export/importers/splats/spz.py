"""`.spz`, versions 2, 3 and 4. Axes are right, up, back, or those of an extension."""

import struct
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from msdgs_export.importers.errors import ImportFailed, cut_off
from msdgs_export.importers.splats.axes import from_right_up_back
from msdgs_export.importers.splats.base import Splats, Stored, parts_of, smallest_three, splats
from msdgs_export.importers.splats.coordinate_systems import MISNAMED, SYSTEMS, from_system
from msdgs_export.importers.splats.spz_container import (
    EXTENSIONS,
    FIELDS,
    LEVELS,
    MIP,
    TREE_BYTES,
    Container,
    Header,
    read_container,
)

COLOR_SCALE = 0.15
"""SH coefficients c of degree 0 are stored as 0.15 c + 0.5 in a byte."""

COORDINATE_SYSTEM = 0xADBE0003
"""Extension SPZ_ADOBE_coordinate_system: the number of the system in which the Gaussians are stored."""

DEFAULT_SYSTEM = "RUB"
"""Right, up, back."""


def read_spz(file: Path, *, converted: bool = True) -> Splats:
    """Read an SPZ file, with its axes converted to those of a PLY if `converted`.

    Of levels of detail, the finest is read. Raises `ImportFailed` for other versions, SH above degree 3, unknown flags
    and damage.
    """
    found = read_container(file)
    system, leaves = DEFAULT_SYSTEM, None
    if found.header.flags & EXTENSIONS:
        system = _system(file, _extensions(file, found.trailing), found.warnings)
    elif found.header.flags & LEVELS:
        leaves = _leaves(file, found.header.count, found.trailing)
    elif found.trailing:
        found.warnings.append(f"its version doesn't define {len(found.trailing):,} of its bytes, which are left out")
    if not converted and system != DEFAULT_SYSTEM:
        found.warnings.append(f"it states the coordinate system {system}, which spz:unturned leaves as it is")
    return replace(_decoded(file, found, leaves, system if converted else None), warnings=tuple(found.warnings))


def _extensions(file: Path, records: bytes) -> dict[int, bytes]:
    """The payload of each extension by its number."""
    found: dict[int, bytes] = {}
    at = 0
    while at < len(records):
        if len(records) - at < 8:
            raise cut_off(file, "the header of an extension", 8, len(records) - at)
        number, size = struct.unpack_from("<II", records, at)
        payload = records[at + 8 : at + 8 + size]
        if len(payload) < size:
            raise cut_off(file, f"extension 0x{number:08X}", size, len(payload))
        found.setdefault(number, payload)
        at += 8 + size
    return found


def _system(file: Path, extensions: dict[int, bytes], warnings: list[str]) -> str:
    """The coordinate system that an extension states; a warning is added for each extension that isn't known."""
    names = {number: f"extension 0x{number:08X}" for number in extensions}
    unknown = FIELDS.unlisted(names.values())
    warnings += [f"its {name} isn't known and is left out: the scene may look different" for name in unknown]
    if COORDINATE_SYSTEM not in extensions:
        return DEFAULT_SYSTEM
    payload = extensions[COORDINATE_SYSTEM]
    if len(payload) < 4:
        raise cut_off(file, names[COORDINATE_SYSTEM], 4, len(payload))
    (number,) = struct.unpack_from("<I", payload)
    if number > len(SYSTEMS):
        raise ImportFailed(file, f"{names[COORDINATE_SYSTEM]} states coordinate system {number}; 1 to 16 are defined")
    if not number:
        warnings.append("its coordinate system is unspecified; it is read as right, up, back, SPZ's usual one")
    system = SYSTEMS[number - 1] if number else DEFAULT_SYSTEM
    if system in MISNAMED:
        meant = MISNAMED[system]
        warnings.append(f"its coordinate system {system} is read as {meant}, which Niantic's library writes so")
    return system


def _leaves(file: Path, count: int, tree: bytes) -> np.ndarray:
    """[N] whether a Gaussian is a leaf of a tree of levels of detail: the Gaussians that the others stand for."""
    if len(tree) < TREE_BYTES * count:
        raise cut_off(file, "the tree of levels of detail", TREE_BYTES * count, len(tree))
    children = np.frombuffer(tree, "<u2", count).astype(np.int64)
    starts = np.frombuffer(tree, "<u4", count, 2 * count).astype(np.int64)
    is_whole = children.sum() == count - 1 and (starts + children)[children > 0].max(initial=0) <= count
    if is_whole:  # all but the root have one parent
        firsts = starts - (np.cumsum(children) - children)
        parents = np.bincount(np.repeat(firsts, children) + np.arange(count - 1), minlength=1)
        is_whole = parents.max() <= 1
    if not is_whole:
        problem = "has levels of detail that aren't one whole tree, as the files that build-lod --spz-chunked writes"
        raise ImportFailed(file, f"{problem}; use what they were made of, or build-lod --spz")
    return children == 0


def _decoded(file: Path, found: Container, leaves: np.ndarray | None, system: str | None) -> Splats:
    """The Gaussians, converted to the axes of a PLY if `system` names theirs."""
    header = found.header
    n = header.count
    arrays = [np.frombuffer(part, np.uint8) for part in found.parts]
    columns = [array.reshape(n, array.size // max(n, 1)) for array in arrays]
    leaf_rows = None if leaves is None else np.flatnonzero(leaves)
    count = n if leaf_rows is None else len(leaf_rows)

    def part(rows: slice) -> Stored:
        read = rows if leaf_rows is None else leaf_rows[rows]
        stored = _part(header, [column[read] for column in columns])
        if leaves is not None:  # opacities are halved, since those of inner nodes may be above 1
            stored = stored._replace(opacities=np.minimum(2 * stored.opacities, 1))
        if system is None:
            return stored
        turned = from_right_up_back if system == DEFAULT_SYSTEM else partial(from_system, system)
        means, quats, sh = turned(stored.means, stored.raw_quats, stored.sh)
        return stored._replace(means=means, raw_quats=quats, sh=sh)

    return splats(file, count, map(part, parts_of(count)), "mip" if header.flags & MIP else "dilate")


def _part(header: Header, columns: Sequence[np.ndarray]) -> Stored:
    """Gaussians of these bytes, [n, ·] of each part of the file."""
    positions, alphas, colors, scales, rotations, rest = columns
    n = len(positions)
    low, middle, high = positions.reshape(n, 3, 3).astype(np.int32).transpose(2, 0, 1)
    fixed = ((low | middle << 8 | high << 16) ^ 0x800000) - 0x800000  # two's complement of 24 bits
    dc = (colors[:, None] / 255 - 0.5) / COLOR_SCALE
    rest = (rest.reshape(n, rest.shape[1] // 3, 3).astype(np.float64) - 128) / 128
    means, log_scales = fixed / 2**header.fractional_bits, scales / 16 - 10
    return Stored(means, log_scales, _quats(header, rotations), alphas[:, 0] / 255, np.concatenate([dc, rest], axis=1))


def _quats(header: Header, rotations: np.ndarray) -> np.ndarray:
    """[N, 4] wxyz. Version 2 stores x, y, z in bytes, later ones the three smallest in a sign and 9 bits each."""
    if header.version == 2:
        xyz = rotations / 127.5 - 1
        w = np.sqrt(np.maximum(0, 1 - np.square(xyz).sum(axis=1)))
        return np.concatenate([w[:, None], xyz], axis=1)
    packed = np.ascontiguousarray(rotations).view("<u4")[:, 0]
    fields = np.stack([packed >> 20, packed >> 10, packed], axis=1) & 1023
    small = (fields & 511) * np.where(fields & 512, -1, 1) * (np.sqrt(0.5) / 511)
    return smallest_three(small, packed >> 30)[:, [3, 0, 1, 2]]

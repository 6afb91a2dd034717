"""`.ksplat` 0.1, the format of mkkellogg's viewer: a header, headers of sections, and Gaussians in buckets."""

import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from msdgs_export.importers.errors import AS_PLY, ImportFailed, cut_off
from msdgs_export.importers.splats.base import Splats, Stored, parts_of, splats
from msdgs_serve.scene.fields import FieldTable
from msdgs_serve.scene.spherical_harmonics import SH_C0, sh_coefficients

FIELDS = FieldTable(
    ".ksplat",
    {
        "versionMajor": "applied",
        "versionMinor": "applied",
        "maxSectionCount": "applied",
        "sectionCount": "harmless",
        "maxSplatCount": "harmless",
        "splatCount": "applied",
        "compressionLevel": "applied",
        "sceneCenter": "harmless",
        "minSphericalHarmonicsCoeff": "applied",
        "maxSphericalHarmonicsCoeff": "applied",
        "section splatCount": "applied",
        "section maxSplatCount": "applied",
        "section bucketSize": "applied",
        "section bucketCount": "applied",
        "section bucketBlockSize": "applied",
        "section bucketStorageSizeBytes": "applied",
        "section compressionScaleRange": "applied",
        "section storageSizeBytes": "harmless",
        "section fullBucketCount": "applied",
        "section partiallyFilledBucketCount": "applied",
        "section sphericalHarmonicsDegree": "applied",
    },
)

HEADER, HEADER_BYTES = struct.Struct("<2B2x4IH2x3f2f"), 4096
SECTION, SECTION_BYTES = struct.Struct("<4IfH2x4IH"), 1024
VERSION = (0, 1)
SCALE_RANGE = 32767
"""Steps of a position on each side of its bucket's center, if the section states none."""

SH_LIMIT = 1.5
"""Coefficients of level 2 are from −1.5 to 1.5, if the header states no others."""

BUCKET_BYTES = 12
MAX_SH_DEGREE = 2


class Header(NamedTuple):
    """The header, without its unused bytes."""

    major: int
    minor: int
    max_sections: int
    sections: int
    max_count: int
    count: int
    level: int
    center_x: float
    center_y: float
    center_z: float
    min_sh: float
    max_sh: float


class Section(NamedTuple):
    """The header of a section; there is room for `max_count` Gaussians, of which the first `count` are there."""

    number: int
    count: int
    max_count: int
    bucket_size: int
    buckets: int
    block_size: float
    bucket_bytes: int
    scale_range: int
    stored_bytes: int
    full_buckets: int
    partial_buckets: int
    sh_degree: int


def read_ksplat(file: Path) -> Splats:
    """The Gaussians of a `.ksplat` file of compression level 0, 1 or 2. Raises `ImportFailed`."""
    contents = file.read_bytes()
    if len(contents) < HEADER_BYTES:
        raise cut_off(file, "the header", HEADER_BYTES, len(contents))
    header = Header(*HEADER.unpack_from(contents))
    if (header.major, header.minor) != VERSION:
        raise ImportFailed(file, f"is .ksplat version {header.major}.{header.minor}; version 0.1 can be read; {AS_PLY}")
    if header.level > 2:
        raise ImportFailed(file, f"has compression level {header.level}; 0, 1 and 2 are defined")
    data = HEADER_BYTES + SECTION_BYTES * header.max_sections
    if data > len(contents):
        raise cut_off(file, f"the headers of {header.max_sections:,} sections", data, len(contents))
    is_defined = not any(contents[2:4]) and not any(contents[HEADER.size : HEADER_BYTES])
    sections: list[tuple[Section, np.ndarray, np.ndarray]] = []
    for number in range(header.max_sections):
        at = HEADER_BYTES + SECTION_BYTES * number
        is_defined &= not any(contents[at + SECTION.size : at + SECTION_BYTES])
        section = Section(number, *SECTION.unpack_from(contents, at))
        end = _end(file, header.level, section, contents, data)
        sections.append((section, *_rows(file, header.level, section, contents, data)))
        data = end
    found = sum(section.count for section, *_ in sections)
    if not sections or found != header.count:
        raise ImportFailed(file, f"states {header.count:,} Gaussians; its {len(sections):,} sections have {found:,}")
    warning = "it has bytes that version 0.1 doesn't define; they are left out"
    return splats(file, found, _parts(header, sections), warnings=() if is_defined else (warning,))


def _record(level: int, sh_degree: int) -> np.dtype:
    """One Gaussian: positions are in steps from a bucket's center above level 0, SH are bytes at level 2."""
    position, number, harmonic = [("<f4", "<f4", "<f4"), ("<u2", "<f2", "<f2"), ("<u2", "<f2", "u1")][level]
    rest = 3 * (sh_coefficients(sh_degree) - 1)
    return np.dtype(
        [
            ("means", position, 3),
            ("scales", number, 3),
            ("quats", number, 4),  # wxyz
            ("rgba", "u1", 4),
            ("sh", harmonic, (rest,)),
        ]
    )


def _end(file: Path, level: int, section: Section, contents: bytes, start: int) -> int:
    """Where a section ends that begins at `start`. Raises `ImportFailed` if its header can't be right."""
    name = f"section {section.number}"
    if section.sh_degree > MAX_SH_DEGREE:
        raise ImportFailed(file, f"{name} has SH of degree {section.sh_degree}; 0, 1 and 2 are defined")
    if section.buckets and section.bucket_bytes != BUCKET_BYTES:
        raise ImportFailed(file, f"{name} has buckets of {section.bucket_bytes} bytes instead of 12")
    if section.count > section.max_count:
        raise ImportFailed(file, f"{name} has {section.count:,} Gaussians, room for {section.max_count:,}")
    size = 4 * section.partial_buckets + BUCKET_BYTES * section.buckets
    size += _record(level, section.sh_degree).itemsize * section.max_count
    if start + size > len(contents):
        raise cut_off(file, name, size, len(contents) - start)
    return start + size


def _rows(file: Path, level: int, section: Section, contents: bytes, start: int) -> tuple[np.ndarray, np.ndarray]:
    """The records of a section and, above level 0, the centers of their buckets, [n, 3]."""
    skipped = 4 * section.partial_buckets + BUCKET_BYTES * section.buckets
    rows = np.frombuffer(contents, _record(level, section.sh_degree), section.count, start + skipped)
    return rows, _centers(file, section, contents, start) if level else np.empty((len(rows), 0), np.float32)


def _parts(header: Header, sections: Sequence[tuple[Section, np.ndarray, np.ndarray]]) -> Iterator[Stored]:
    """The Gaussians of all sections in parts; SH that a section doesn't have are 0."""
    widest = max(sh_coefficients(section.sh_degree) for section, *_ in sections)
    for section, records, centers in sections:
        for rows in parts_of(len(records)):
            with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
                part = _decoded(header, section, records[rows], centers[rows])
            yield part._replace(sh=np.pad(part.sh, ((0, 0), (0, widest - part.sh.shape[1]), (0, 0))))


def _decoded(header: Header, section: Section, rows: np.ndarray, centers: np.ndarray) -> Stored:
    means = rows["means"].astype(np.float64)
    if header.level:
        steps = section.scale_range or SCALE_RANGE
        means = (means - steps) * (section.block_size / 2 / steps) + centers
    rgba, rest = rows["rgba"] / 255, rows["sh"].astype(np.float64)
    if header.level == 2:
        low, high = header.min_sh or -SH_LIMIT, header.max_sh or SH_LIMIT
        rest = low + rest / 255 * (high - low)
    # within a degree, the coefficients of red come first, then those of green and of blue
    bands = [
        rest[:, 3 * (k * k - 1) : 3 * ((k + 1) ** 2 - 1)].reshape(-1, 3, 2 * k + 1).transpose(0, 2, 1)
        for k in range(1, section.sh_degree + 1)
    ]
    dc = (rgba[:, None, :3] - 0.5) / SH_C0
    log_scales = np.log(rows["scales"].astype(np.float64))
    return Stored(means, log_scales, rows["quats"], rgba[:, 3], np.concatenate([dc, *bands], axis=1))


def _centers(file: Path, section: Section, contents: bytes, start: int) -> np.ndarray:
    """[n, 3] the center of each Gaussian's bucket: full buckets come first, then those whose lengths are listed."""
    filled = section.full_buckets + section.partial_buckets
    lengths = np.frombuffer(contents, "<u4", section.partial_buckets, start).astype(np.int64)
    held = section.full_buckets * section.bucket_size + int(lengths.sum())
    if filled > section.buckets or held < section.count:
        problem = f"has {section.count:,} Gaussians and {section.buckets:,} buckets"
        raise ImportFailed(file, f"section {section.number} {problem}, of which {filled:,} are filled with {held:,}")
    centers = np.frombuffer(contents, "<f4", 3 * section.buckets, start + lengths.size * 4).reshape(-1, 3)
    ends = np.cumsum(np.concatenate([np.full(section.full_buckets, section.bucket_size), lengths]))
    return centers[np.searchsorted(ends, np.arange(section.count), side="right")]

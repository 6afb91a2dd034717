"""The container of an SPZ file: its header, the streams of its attributes, and what follows them.

Versions 2 and 3 are one gzip stream, version 4 has a zstd stream per attribute and its extensions in front of them.
"""

import itertools
import struct
import zlib
from pathlib import Path
from typing import NamedTuple

from msdgs_export.importers.errors import AS_PLY, ImportFailed, cut_off
from msdgs_serve.scene.fields import FieldTable

FIELDS = FieldTable(
    "SPZ",
    {
        "version": "applied",
        "numPoints": "applied",
        "shDegree": "applied",
        "fractionalBits": "applied",
        "flag 0x01": "applied",
        "flag 0x02": "applied",
        "flag 0x80": "applied",
        "flag *": "refused",
        "reserved": "harmless",
        "numStreams": "applied",
        "tocByteOffset": "applied",
        "positions": "applied",
        "alphas": "applied",
        "colors": "applied",
        "scales": "applied",
        "rotations": "applied",
        "sh": "applied",
        "childCounts": "applied",
        "childStarts": "applied",
        "extension 0xADBE0002": "harmless",
        "extension 0xADBE0003": "applied",
    },
)

MAGIC = b"NGSP"
GZIP = b"\x1f\x8b"
HEADER = struct.Struct("<4sIIBBBB")
LONG_HEADER_BYTES = 32
"""Header of version 4: that of the others, the offset of the table of streams, and 12 reserved bytes."""

MIP, EXTENSIONS, LEVELS = 0x01, 0x02, 0x80
"""Flags: trained with the anti-aliasing of Mip-Splatting; extensions; a tree of levels of detail, as Spark writes."""

TREE_BYTES = 6
"""Bytes of the tree for each Gaussian: the number of children and the first of them."""

MAX_EXTENSIONS = 1 << 20
"""Most bytes of extensions behind the attributes of versions 2 and 3."""

DEFLATE_LIMIT = 1_032
"""Largest compression factor of Deflate."""


class Header(NamedTuple):
    """The first 16 bytes, without the magic."""

    version: int
    count: int
    sh_degree: int
    fractional_bits: int
    flags: int
    streams: int  # of version 4; reserved in the others

    @property
    def sizes(self) -> list[int]:
        """Bytes of positions, opacities, colors, scales, rotations and SH above degree 0."""
        rotation, rest = (3 if self.version == 2 else 4), 3 * ((self.sh_degree + 1) ** 2 - 1)
        return [self.count * each for each in (9, 1, 3, 3, rotation, rest)]

    @property
    def max_trailing(self) -> int:
        """The most bytes that may follow the attributes of versions 2 and 3."""
        return TREE_BYTES * self.count if self.flags & LEVELS else MAX_EXTENSIONS


class Container(NamedTuple):
    """The decompressed contents of a file."""

    header: Header
    parts: list[bytes]  # of the sizes of the header
    trailing: bytes  # extensions or the tree of levels of detail
    warnings: list[str]


def read_container(file: Path) -> Container:
    """Decompress a file. Raises `ImportFailed` for other versions, unknown flags and damage."""
    contents = file.read_bytes()
    if contents.startswith(GZIP):
        header, body = _unzipped(file, contents)
    elif contents.startswith(MAGIC):
        header, body = _header(file, contents[: HEADER.size]), contents[HEADER.size :]
    else:
        raise ImportFailed(file, "isn't an SPZ file: it begins neither as gzip nor with NGSP")
    if header.version == 4:
        return _of_streams(file, header, contents)
    size = sum(header.sizes)
    if len(body) < size:
        raise cut_off(file, f"{header.count:,} Gaussians", size, len(body))
    if len(body) - size > header.max_trailing:
        raise ImportFailed(file, f"has more than {header.max_trailing:,} bytes behind its {header.count:,} Gaussians")
    ends = list(itertools.accumulate(header.sizes))
    parts = [body[end - part : end] for end, part in zip(ends, header.sizes, strict=True)]
    return Container(header, parts, body[size:], _reserved(header.streams != 0))


def _reserved(is_set: bool) -> list[str]:
    return ["its reserved bytes aren't 0; they are left out"] if is_set else []


def _header(file: Path, start: bytes) -> Header:
    if len(start) < HEADER.size:
        raise cut_off(file, "the header", HEADER.size, len(start))
    magic, *fields = HEADER.unpack(start)
    header = Header(*fields)
    if magic != MAGIC:
        raise ImportFailed(file, f"isn't an SPZ file: NGSP expected, found {magic!r}")
    if header.version not in (2, 3, 4):
        raise ImportFailed(file, f"is SPZ version {header.version}; versions 2, 3 and 4 can be read; {AS_PLY}")
    if not header.count:
        raise ImportFailed(file, "holds no Gaussians")
    if header.sh_degree > 3:
        raise ImportFailed(file, f"has SH of degree {header.sh_degree}; up to 3 can be read: write it with fewer")
    if header.fractional_bits > 24:
        raise ImportFailed(file, f"has positions with {header.fractional_bits} fractional bits out of 24")
    _check_flags(file, header)
    return header


def _check_flags(file: Path, header: Header) -> None:
    """Raise `ImportFailed` for flags that could change the meaning of anything else."""
    names = [f"flag 0x{1 << bit:02X}" for bit in range(8) if header.flags >> bit & 1]
    unknown = [name for name in names if FIELDS.use(name) == "refused"]
    if unknown:
        raise ImportFailed(file, f"has {', '.join(unknown)}, which SPZ 2, 3 and 4 don't define; {AS_PLY}")
    if header.flags & LEVELS and (header.version == 4 or header.flags & EXTENSIONS):
        other = "in version 4" if header.version == 4 else "together with flag 0x02 for extensions"
        raise ImportFailed(file, f"has flag 0x80 for levels of detail {other}, where its layout isn't known; {AS_PLY}")


def _unzipped(file: Path, contents: bytes) -> tuple[Header, bytes]:
    """Decompress the header, and then as many bytes as it states, and what may follow."""
    unpacker = zlib.decompressobj(wbits=31)
    try:
        header = _header(file, unpacker.decompress(contents, HEADER.size))
        if header.version == 4:
            raise ImportFailed(file, "is SPZ version 4 inside gzip, but version 4 has its own streams")
        needed, possible = sum(header.sizes), DEFLATE_LIMIT * len(contents)
        if needed > possible:
            raise cut_off(file, f"{header.count:,} Gaussians", needed, possible)
        body = unpacker.decompress(unpacker.unconsumed_tail, needed + header.max_trailing + 1)
    except zlib.error:
        raise ImportFailed(file, "has a damaged gzip stream") from None
    if len(body) >= needed and not unpacker.eof and not unpacker.unconsumed_tail:
        raise ImportFailed(file, "is cut off: its gzip stream has no end")
    return header, body


def _of_streams(file: Path, header: Header, contents: bytes) -> Container:
    """The parts of version 4: the header, extensions, a table of sizes at the offset in the header, the streams."""
    if len(contents) < LONG_HEADER_BYTES:
        raise cut_off(file, "the header", LONG_HEADER_BYTES, len(contents))
    table, reserved = struct.unpack_from("<I12s", contents, HEADER.size)
    sizes = header.sizes if header.sh_degree else header.sizes[:5]
    if header.streams < len(sizes):
        raise ImportFailed(file, f"has {header.streams} streams; SH of degree {header.sh_degree} needs {len(sizes)}")
    at = table + 16 * header.streams
    if table < LONG_HEADER_BYTES or at > len(contents):
        raise cut_off(file, "the table of streams", at, len(contents))
    warnings = _reserved(any(reserved))
    if header.streams > len(sizes):
        warnings.append(f"it has {header.streams} streams, of which only the first {len(sizes)} are known and read")
    parts = []
    for i, size in enumerate(sizes):
        packed, unpacked = struct.unpack_from("<QQ", contents, table + 16 * i)
        if unpacked != size:
            raise ImportFailed(file, f"stream {i} has {unpacked:,} bytes; {header.count:,} Gaussians need {size:,}")
        if at + packed > len(contents):
            raise cut_off(file, f"stream {i}", packed, len(contents) - at)
        parts.append(_zstd(file, i, contents[at : at + packed], size))
        at += packed
    return Container(header, [*parts, b""][: len(header.sizes)], contents[LONG_HEADER_BYTES:table], warnings)


def _zstd(file: Path, number: int, packed: bytes, size: int) -> bytes:
    if not size:
        return b""
    try:
        import zstandard
    except ModuleNotFoundError:
        raise ImportFailed(file, "is SPZ version 4, which needs zstandard: pip install 'msdgs[export]'") from None
    try:
        stated = zstandard.frame_content_size(packed)
        if stated not in (-1, size):
            raise ImportFailed(file, f"stream {number} holds {stated:,} bytes instead of {size:,}")
        found = bytearray()
        with zstandard.ZstdDecompressor(max_window_size=1 << 27).stream_reader(packed) as reader:
            while len(found) < size and (piece := reader.read(min(size - len(found), 1 << 24))):
                found += piece
    except zstandard.ZstdError:
        raise ImportFailed(file, f"has a damaged zstd stream {number}") from None
    if len(found) < size:
        raise cut_off(file, f"stream {number}", size, len(found))
    return bytes(found)

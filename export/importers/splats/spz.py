"""`.spz`, versions 2 and 3 (one gzip stream) and 4 (a zstd stream per attribute). Axes are right, up, back."""

import itertools
import struct
import zlib
from pathlib import Path
from typing import NamedTuple

import numpy as np
import zstandard

from export.importers.errors import ImportFailed, cut_off
from export.importers.splats.axes import from_right_up_back
from export.importers.splats.base import Splats, smallest_three, splats

MAGIC = b"NGSP"
GZIP = b"\x1f\x8b"
HEADER = struct.Struct("<4sIIBBBB")
MIP = 1
"""Bit of the header's flags: trained with the anti-aliasing of Mip-Splatting."""

COLOR_SCALE = 0.15
"""SH coefficients c of degree 0 are stored as 0.15 c + 0.5 in a byte."""

DEFLATE_LIMIT = 1_032
"""Largest compression factor of Deflate."""


class Header(NamedTuple):
    """The first 16 bytes, without the magic."""

    version: int
    count: int
    sh_degree: int
    fractional_bits: int
    flags: int
    streams: int  # of version 4

    @property
    def sizes(self) -> list[int]:
        """Bytes of positions, opacities, colors, scales, rotations and SH above degree 0."""
        rotation, rest = (3 if self.version == 2 else 4), 3 * ((self.sh_degree + 1) ** 2 - 1)
        return [self.count * each for each in (9, 1, 3, 3, rotation, rest)]


def read_spz(file: Path, *, converted: bool = True) -> Splats:
    """Read an SPZ file, with its axes converted to those of a PLY if `converted`.

    Raises `ImportFailed` for other versions, SH above degree 3 and cut-off files.
    """
    contents = file.read_bytes()
    if contents.startswith(GZIP):
        header, body = _unzipped(file, contents)
    elif contents.startswith(MAGIC):
        header, body = _header(file, contents[: HEADER.size]), contents[HEADER.size :]
    else:
        raise ImportFailed(file, "isn't an SPZ file: it begins neither as gzip nor with NGSP")
    parts = _streams(file, header, contents) if header.version == 4 else _parts(file, header, body)
    return _decoded(file, header, parts, converted)


def _header(file: Path, start: bytes) -> Header:
    if len(start) < HEADER.size:
        raise cut_off(file, "the header", HEADER.size, len(start))
    magic, version, count, sh_degree, fractional_bits, flags, streams = HEADER.unpack(start)
    if magic != MAGIC:
        raise ImportFailed(file, f"isn't an SPZ file: NGSP expected, found {magic!r}")
    if version not in (2, 3, 4):
        raise ImportFailed(file, f"is SPZ version {version}; versions 2, 3 and 4 can be read")
    if sh_degree > 3:
        raise ImportFailed(file, f"has SH of degree {sh_degree}; up to 3 can be read")
    if fractional_bits > 24:
        raise ImportFailed(file, f"has positions with {fractional_bits} fractional bits out of 24")
    return Header(version, count, sh_degree, fractional_bits, flags, streams)


def _unzipped(file: Path, contents: bytes) -> tuple[Header, bytes]:
    """Decompress the header, and then as many bytes as it states."""
    unpacker = zlib.decompressobj(wbits=31)
    try:
        header = _header(file, unpacker.decompress(contents, HEADER.size))
        if header.version == 4:
            raise ImportFailed(file, "is SPZ version 4 inside gzip, but version 4 has its own streams")
        needed, possible = sum(header.sizes), DEFLATE_LIMIT * len(contents)
        if needed > possible:
            raise cut_off(file, f"{header.count:,} Gaussians", needed, possible)
        body = unpacker.decompress(unpacker.unconsumed_tail, needed) if needed else b""
        more = len(body) < needed or unpacker.decompress(unpacker.unconsumed_tail, 1)  # reads the checksum at the end
    except zlib.error as error:
        raise ImportFailed(file, f"has a damaged gzip stream: {error}") from error
    if not more and not unpacker.eof:
        raise ImportFailed(file, "is cut off: its gzip stream has no end")
    return header, body


def _parts(file: Path, header: Header, body: bytes) -> list[bytes]:
    """The parts of versions 2 and 3, one after the other."""
    if len(body) < sum(header.sizes):
        raise cut_off(file, f"{header.count:,} Gaussians", sum(header.sizes), len(body))
    ends = list(itertools.accumulate(header.sizes))
    return [body[end - size : end] for end, size in zip(ends, header.sizes, strict=True)]


def _streams(file: Path, header: Header, contents: bytes) -> list[bytes]:
    """The parts of version 4: a header of 32 bytes with the offset of a table of sizes, the table, the streams."""
    if len(contents) < 32:
        raise cut_off(file, "the header", 32, len(contents))
    (table,) = struct.unpack_from("<I", contents, 16)
    sizes = header.sizes if header.sh_degree else header.sizes[:5]
    if header.streams < len(sizes):
        raise ImportFailed(file, f"has {header.streams} streams; SH of degree {header.sh_degree} needs {len(sizes)}")
    at = table + 16 * header.streams
    if not table >= 32 or at > len(contents):
        raise cut_off(file, "the table of streams", at, len(contents))
    parts = []
    for i, size in enumerate(sizes):
        packed, unpacked = struct.unpack_from("<QQ", contents, table + 16 * i)
        if unpacked != size:
            raise ImportFailed(file, f"stream {i} has {unpacked:,} bytes; {header.count:,} Gaussians need {size:,}")
        if at + packed > len(contents):
            raise cut_off(file, f"stream {i}", packed, len(contents) - at)
        parts.append(_zstd(file, i, contents[at : at + packed], size))
        at += packed
    return [*parts, b""][: len(header.sizes)]


def _zstd(file: Path, number: int, packed: bytes, size: int) -> bytes:
    if not size:
        return b""
    try:
        stated = zstandard.frame_content_size(packed)
        if stated not in (-1, size):
            raise ImportFailed(file, f"stream {number} holds {stated:,} bytes instead of {size:,}")
        found = bytearray()
        with zstandard.ZstdDecompressor(max_window_size=1 << 27).stream_reader(packed) as reader:
            while len(found) < size and (piece := reader.read(min(size - len(found), 1 << 24))):
                found += piece
    except zstandard.ZstdError as error:
        raise ImportFailed(file, f"has a damaged zstd stream {number}: {error}") from error
    if len(found) < size:
        raise cut_off(file, f"stream {number}", size, len(found))
    return bytes(found)


def _decoded(file: Path, header: Header, parts: list[bytes], converted: bool) -> Splats:
    positions, opacities, colors, scales, rotations, rest = (np.frombuffer(part, np.uint8) for part in parts)
    n = header.count
    low, middle, high = positions.reshape(n, 3, 3).astype(np.int32).transpose(2, 0, 1)
    fixed = ((low | middle << 8 | high << 16) ^ 0x800000) - 0x800000  # two's complement of 24 bits
    dc = (colors.reshape(n, 1, 3) / 255 - 0.5) / COLOR_SCALE
    sh = np.concatenate([dc, (rest.reshape(n, -1, 3).astype(np.float64) - 128) / 128], axis=1)
    means, quats = fixed / 2**header.fractional_bits, _quats(header, rotations)
    if converted:
        means, quats, sh = from_right_up_back(means, quats, sh)
    return splats(
        file,
        means,
        scales.reshape(n, 3) / 16 - 10,
        quats,
        opacities / 255,
        sh,
        "mip" if header.flags & MIP else "dilate",
    )


def _quats(header: Header, rotations: np.ndarray) -> np.ndarray:
    """[N, 4] wxyz. Version 2 stores x, y, z in bytes, later ones the three smallest in a sign and 9 bits each."""
    if header.version == 2:
        xyz = rotations.reshape(-1, 3) / 127.5 - 1
        w = np.sqrt(np.maximum(0, 1 - np.square(xyz).sum(axis=1)))
        return np.concatenate([w[:, None], xyz], axis=1)
    packed = rotations.view("<u4")
    fields = np.stack([packed >> 20, packed >> 10, packed], axis=1) & 1023
    small = (fields & 511) * np.where(fields & 512, -1, 1) * (np.sqrt(0.5) / 511)
    return smallest_three(small, packed >> 30)[:, [3, 0, 1, 2]]

"""What OpenImageIO doesn't tell of a JPEG: that it is cut off, and its image for usual screens beside one in HDR."""

import re
from typing import BinaryIO

START = b"\xff\xd8"
MARKER = re.compile(rb"\xff([^\x00\xd0-\xd7\xff])", re.DOTALL)
"""In the data of a scan, where 0xff before 0 is a value, and before 0xd0 to 0xd7 a restart."""
END_OF_IMAGE = b"\xd9"

GAIN_MAP = b"hdrgm:Version"
"""Metadata of Ultra HDR: the file is a usual JPEG, followed by a map of gains that makes it HDR."""
HEAD = 1 << 18
"""Bytes at the beginning of a file that hold the metadata."""


def is_whole(content: bytes) -> bool:
    """Whether the first image of a JPEG file reaches its end, whatever follows."""
    place = len(START)
    while (marker := MARKER.search(content, place)) is not None:
        if marker[1] == END_OF_IMAGE:
            return True
        place = marker.end() + int.from_bytes(content[marker.end() : marker.end() + 2])
    return False


def has_gain_map(file: BinaryIO) -> bool:
    """Whether a file, at its beginning, is in Ultra HDR."""
    return file.read(len(START)) == START and GAIN_MAP in file.read(HEAD)


def without_gain_map(content: bytes) -> bytes:
    """The same file, as a usual JPEG to all readers."""
    return content.replace(GAIN_MAP, GAIN_MAP.swapcase())

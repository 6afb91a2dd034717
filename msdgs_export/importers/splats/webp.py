"""Lossless WebP textures of numbers."""

import struct
import tempfile
from pathlib import Path

import numpy as np
import OpenImageIO as oiio

from msdgs_export.importers.errors import ImportFailed


def read_texture(file: Path, name: str, contents: bytes, pixels: int) -> np.ndarray:
    """[H · W, 4] bytes of the texture `name` of `file`, which has at most `pixels`. Raises `ImportFailed`."""
    texture = f"its texture {name}"
    width, height = _size(file, texture, contents)
    if width * height > pixels:
        raise ImportFailed(file, f"{texture} has {width} × {height} pixels, at most {pixels:,} are allowed")
    straight = oiio.ImageSpec()
    straight.attribute("oiio:UnassociatedAlpha", 1)
    with tempfile.NamedTemporaryFile(suffix=".webp") as copy:  # OpenImageIO reads files only
        copy.write(contents)
        copy.flush()
        reader = oiio.ImageInput.open(copy.name, straight)
        if reader is None:
            raise ImportFailed(file, f"{texture} can't be read: {oiio.geterror() or 'not an image'}")
        shown = reader.read_image(oiio.UINT8)
        problem = reader.geterror()
        reader.close()
    if shown is None or shown.shape[:2] != (height, width) or shown.shape[2] not in (3, 4):
        raise ImportFailed(file, f"{texture} can't be read: {problem or 'damaged'}")
    if shown.shape[2] == 3:
        shown = np.concatenate([shown, np.full((height, width, 1), 255, np.uint8)], axis=2)
    return shown.reshape(-1, 4)


def _size(file: Path, texture: str, contents: bytes) -> tuple[int, int]:
    """The size in the header, checked before the decoder allocates memory."""
    if len(contents) < 30 or contents[:4] != b"RIFF" or contents[8:12] != b"WEBP":
        raise ImportFailed(file, f"{texture} isn't a whole WebP image")
    (length,) = struct.unpack_from("<I", contents, 4)
    if length + 8 > len(contents):
        raise ImportFailed(file, f"{texture} is cut off: {length + 8:,} bytes needed, {len(contents):,} found")
    kind = contents[12:16]
    if kind == b"VP8L":
        (packed,) = struct.unpack_from("<I", contents, 21)
        return (packed & 0x3FFF) + 1, (packed >> 14 & 0x3FFF) + 1
    if kind == b"VP8X":
        width, height = (int.from_bytes(contents[at : at + 3], "little") + 1 for at in (24, 27))
        return width, height
    raise ImportFailed(file, f"{texture} is a lossy WebP image, which changes its numbers")

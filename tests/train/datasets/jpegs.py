"""JPEG files, also in Ultra HDR: a usual JPEG and, after it, a map of gains that makes it HDR."""

import io
import struct
from typing import Any

import numpy as np
from PIL import Image

XMP = b"http://ns.adobe.com/xap/1.0/\0"
BEGIN = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    '<rdf:Description xmlns:hdrgm="http://ns.adobe.com/hdr-gain-map/1.0/" hdrgm:Version="1.0" '
)
END = "</rdf:RDF></x:xmpmeta>"
GAINS = 'hdrgm:GainMapMax="2" hdrgm:HDRCapacityMax="2"/>'
DIRECTORY = (
    'xmlns:Container="http://ns.google.com/photos/1.0/container/" '
    'xmlns:Item="http://ns.google.com/photos/1.0/container/item/"><Container:Directory><rdf:Seq>'
    '<rdf:li rdf:parseType="Resource"><Container:Item Item:Semantic="Primary" Item:Mime="image/jpeg"/></rdf:li>'
    '<rdf:li rdf:parseType="Resource"><Container:Item Item:Semantic="GainMap" Item:Mime="image/jpeg" '
    'Item:Length="{}"/></rdf:li></rdf:Seq></Container:Directory></rdf:Description>'
)


def jpeg(pixels: np.ndarray, **options: Any) -> bytes:
    """A JPEG of uint8 [H, W] or [H, W, 3]."""
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "JPEG", **options)
    return stream.getvalue()


def ultra_hdr(pixels: np.ndarray) -> bytes:
    """A JPEG of uint8 [H, W, 3] with a map of gains."""
    gains = _described(jpeg(np.full((16, 16), 120, np.uint8)), BEGIN + GAINS + END)
    image = _described(jpeg(pixels), BEGIN + DIRECTORY.format(len(gains)) + END)
    entries = 10 + 3 * 12 + 4  # the header of MPF, its directory, and then two images of 16 bytes
    before = 4 + 4 + entries + 8 + 24
    size = len(image) + before
    fields = struct.pack(">HHI4sHHIIHHIII", 0xB000, 7, 4, b"0100", 0xB001, 4, 1, 2, 0xB002, 7, 32, entries, 0)
    images = struct.pack(">IIIIIIII", 0x30000, size, 0, 0, 0, len(gains), size, 0)
    mpf = b"MPF\0MM\0\x2a" + struct.pack(">IH", 8, 3) + fields + images
    return image[:2] + _segment(0xE2, mpf) + image[2:] + gains


def _described(content: bytes, metadata: str) -> bytes:
    return content[:2] + _segment(0xE1, XMP + metadata.encode()) + content[2:]


def _segment(marker: int, content: bytes) -> bytes:
    return struct.pack(">BBH", 0xFF, marker, len(content) + 2) + content

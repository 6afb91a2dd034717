"""Random changes of protobuf's encoding: of fields, lengths and numbers, at any depth."""

from typing import Any

import numpy as np
from google.protobuf.empty_pb2 import Empty
from google.protobuf.message import DecodeError
from google.protobuf.unknown_fields import UnknownFieldSet

from tests.support.hostile_scenes import field, varint

Rng = np.random.Generator
Part = tuple[int, int, Any]  # number, wire type, content

DEEPEST = 5
VARINT, LENGTH, GROUP = 0, 2, 3
FIXED = {1: 8, 5: 4}
"""Bytes of fields that are stored without their length, by wire type."""


def changed_wire(message: bytes, rng: Rng, depth: int = 1) -> bytes:
    """Return the message with one change to a field of it or of a message inside it."""
    parts = _parts(message)
    if not parts:
        return message[: int(rng.integers(len(message) + 1))]
    index = int(rng.integers(len(parts)))
    number, wire_type, content = parts[index]
    whole = [_written(part) for part in parts]
    if wire_type == LENGTH and depth < DEEPEST and rng.random() < 0.75 and _parts(content):
        whole[index] = _written((number, wire_type, changed_wire(content, rng, depth + 1)))
    else:
        whole[index] = _changed(parts[index], rng)
    return b"".join(whole)


def _changed(part: Part, rng: Rng) -> bytes:
    number, wire_type, content = part
    sound = _written(part)
    if wire_type == VARINT:
        numbers = [
            sound + sound,
            varint(number << 3) + _long(content),
            field(number, content + 2**32),
            field(number, content + 2**63),
            varint(number << 3) + b"\xff" * 10 + b"\x01",
            field(number, b"\x00"),
            b"",
        ]
        return numbers[int(rng.integers(len(numbers)))]
    length = len(content)
    flipped = bytearray(content)
    if length:
        flipped[int(rng.integers(length))] ^= 1 << int(rng.integers(8))
    key = varint(number << 3 | wire_type)
    texts = [
        sound + sound,
        sound + field(int(rng.integers(1, 40)), b"x"),
        sound + field(int(rng.integers(1, 40)), int(rng.integers(2**40))),
        _long(number << 3 | wire_type) + sound[len(key) :],
        key + _long(length) + content,
        key + varint(length + int(rng.integers(1, 2**20))) + content,
        key + varint(2**63 + length) + content,
        _written((number, wire_type, bytes(flipped))),
        _written((number, wire_type, content[: int(rng.integers(length + 1))])),
        varint(number << 3 | GROUP) + content + varint(number << 3 | 4),
        varint(number << 3 | 5) + content[:4].ljust(4, b"\0"),
        b"",
    ]
    return texts[int(rng.integers(len(texts)))]


def _long(value: int) -> bytes:
    """Encode a number in one byte more than it needs."""
    short = varint(value)
    return short[:-1] + bytes([short[-1] | 0x80, 0])


def _written(part: Part) -> bytes:
    number, wire_type, content = part
    if wire_type in FIXED:
        return varint(number << 3 | wire_type) + content
    return field(number, content)


def _parts(message: bytes) -> list[Part] | None:
    """Return the fields of a message; None for bytes that aren't a message."""
    try:
        fields = UnknownFieldSet(Empty.FromString(message))
    except DecodeError:
        return None
    parts = [(part.field_number, part.wire_type, part.data) for part in fields]
    if any(wire_type == GROUP for _, wire_type, _ in parts):
        return None
    return [(n, kind, data.to_bytes(FIXED[kind], "little") if kind in FIXED else data) for n, kind, data in parts]

"""Bytes of protobuf changed at random where their structure shows: fields, lengths and numbers, at any depth."""

import numpy as np

from tests.support.hostile_scenes import field, varint

Rng = np.random.Generator
Part = tuple[int, int, bytes | int]  # number, wire type, content

DEEPEST = 5


def changed_wire(message: bytes, rng: Rng) -> bytes:
    """One change to a field of the message or of one inside it."""
    path: list[tuple[list[Part], int]] = []
    parts = _parts(message)
    while parts:
        index = int(rng.integers(len(parts)))
        path.append((parts, index))
        content = parts[index][2]
        inner = _parts(content) if isinstance(content, bytes) and len(path) < DEEPEST and rng.random() < 0.75 else None
        if not inner:
            break
        parts = inner
    if not path:
        return message[: int(rng.integers(len(message) + 1))]
    parts, index = path.pop()
    written = b"".join([*map(_written, parts[:index]), _changed(parts[index], rng), *map(_written, parts[index + 1 :])])
    for outer, place in reversed(path):
        number, wire_type, _ = outer[place]
        whole = [_written(part) for part in outer]
        whole[place] = _written((number, wire_type, written))
        written = b"".join(whole)
    return written


def _changed(part: Part, rng: Rng) -> bytes:
    number, wire_type, content = part
    sound = _written(part)
    if isinstance(content, int):
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
        varint(number << 3 | 3) + content + varint(number << 3 | 4),
        varint(number << 3 | 5) + content[:4].ljust(4, b"\0"),
        b"",
    ]
    return texts[int(rng.integers(len(texts)))]


def _long(value: int) -> bytes:
    """In one byte more than it needs."""
    short = varint(value)
    return short[:-1] + bytes([short[-1] | 0x80, 0])


def _written(part: Part) -> bytes:
    number, wire_type, content = part
    if isinstance(content, int):
        return varint(number << 3) + varint(content)
    head = varint(number << 3 | wire_type)
    return head + content if wire_type in (1, 5) else head + varint(len(content)) + content


def _parts(message: bytes) -> list[Part] | None:
    """The fields of a message; None for bytes that aren't one."""
    parts: list[Part] = []
    position = 0
    while position < len(message):
        key, position = _read_varint(message, position)
        number, wire_type = key >> 3, key & 7
        if not number or position < 0:
            return None
        if wire_type == 0:
            value, position = _read_varint(message, position)
            parts.append((number, wire_type, value))
        elif wire_type in (1, 2, 5):
            length = {1: 8, 5: 4}.get(wire_type, 0)
            if wire_type == 2:
                length, position = _read_varint(message, position)
            if position < 0 or position + length > len(message):
                return None
            parts.append((number, wire_type, message[position : position + length]))
            position += length
        else:
            return None
        if position < 0:
            return None
    return parts


def _read_varint(message: bytes, position: int) -> tuple[int, int]:
    """Its value and where it ends; a negative place for what isn't one."""
    result = 0
    for shift in range(0, 64, 7):
        if position >= len(message):
            return 0, -1
        byte = message[position]
        position += 1
        result |= (byte & 0x7F) << shift
        if byte < 0x80:
            return result, position
    return 0, -1

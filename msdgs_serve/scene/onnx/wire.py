"""Protobuf's wire format (https://protobuf.dev/programming-guides/encoding), read strictly.

A lenient reader may understand the same bytes differently than onnxruntime. Here each value has one encoding: only
known fields of the expected wire type, singular fields once, and numbers in the fewest bytes and within their type.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any

MAX_NAME, MAX_TEXT = 200, 1 << 20
"""Limits of bytes in a name and in any other text."""

_VARINT, _LENGTH = 0, 2
_FIXED_BYTES = {1: 8, 5: 4}


class ModelInvalid(ValueError):
    """The bytes aren't a valid model of a scene file. `field` names the node, the constant or the file."""

    def __init__(self, field: str, problem: str) -> None:
        super().__init__(f"`{field}` {problem}")
        self.field = field
        self.problem = problem


class Kind(Enum):
    """The kind of a field's value."""

    INTEGER = "int64"
    ENUM = "number from 0 to 2³¹ − 1"
    NAME = "printable text of at most 200 bytes"
    TEXT = "UTF-8 text of at most 1 MiB"
    BYTES = "bytes"
    SKIPPED = "skipped"  # of any wire type; never passed on
    REJECTED = "rejected"


@dataclass(frozen=True)
class Field:
    """A field of a message and how often it may occur; singular fields once."""

    name: str
    kind: Kind
    max_count: int = 1


Schema = Mapping[int, Field]


def read_message(message: memoryview, schema: Schema, name: str) -> dict[str, Any]:
    """Return values by field name: lists for repeated fields, single values for singular ones that are present.

    Bytes are views of `message`; `name` is for error messages. Raises `ModelInvalid` about `file`.
    """
    values: dict[str, Any] = {field.name: [] for field in schema.values() if field.max_count > 1}
    position, counts = 0, dict[int, int]()
    while position < len(message):
        key, position = _varint(message, position)
        number, wire_type = key >> 3, key & 7
        field = schema.get(number)
        if field is None:
            raise _invalid(f"{name} has the unknown field {number}")
        if field.kind is Kind.REJECTED:
            raise _invalid(f"{name} has `{field.name}`, which a scene file may not have")
        counts[number] = counts.get(number, 0) + 1
        if counts[number] > field.max_count:
            often = "once" if field.max_count == 1 else f"{field.max_count:,} times"
            raise _invalid(f"{name} has `{field.name}` more than {often}")
        value, position = _value(message, position, wire_type, field, name)
        if field.max_count > 1:
            values[field.name].append(value)
        else:
            values[field.name] = value
    return values


def read_integers(packed: memoryview) -> list[int]:
    """Return a packed list of int32 or int64. Raises `ModelInvalid` about `file`."""
    numbers, position = [], 0
    while position < len(packed):
        number, position = _varint(packed, position)
        numbers.append(_signed(number))
    return numbers


def _value(message: memoryview, position: int, wire_type: int, field: Field, name: str) -> tuple[Any, int]:
    """Return the value at a position and the position of its end."""
    numeric = field.kind in (Kind.INTEGER, Kind.ENUM)
    if field.kind is not Kind.SKIPPED and wire_type != (_VARINT if numeric else _LENGTH):
        raise _invalid(f"{name} has `{field.name}` of wire type {wire_type}, not a {field.kind.value}")
    if wire_type == _VARINT:
        number, position = _varint(message, position)
        return (_number(number, field, name) if numeric else None), position
    if wire_type == _LENGTH:
        length, position = _varint(message, position)
    elif wire_type in _FIXED_BYTES:
        length = _FIXED_BYTES[wire_type]
    else:
        raise _invalid(f"{name} has a field of wire type {wire_type}, which is unknown")
    if length > len(message) - position:
        raise _invalid("it is truncated")
    part = message[position : position + length]
    if field.kind in (Kind.NAME, Kind.TEXT):
        return _text(part, field, name), position + length
    return part, position + length


def _number(value: int, field: Field, name: str) -> int:
    if field.kind is Kind.ENUM and value >= 1 << 31:
        raise _invalid(f"{name} has `{field.name}` {value}, not a {field.kind.value}")
    return _signed(value)


def _signed(value: int) -> int:
    return value - (1 << 64) if value >= 1 << 63 else value


def _text(part: memoryview, field: Field, name: str) -> str:
    if len(part) > (MAX_NAME if field.kind is Kind.NAME else MAX_TEXT):
        raise _invalid(f"{name} has `{field.name}` of {len(part):,} bytes, not {field.kind.value}")
    try:
        text = str(part, "utf-8")
    except UnicodeDecodeError:
        raise _invalid(f"{name} has `{field.name}` that isn't UTF-8") from None
    if field.kind is Kind.NAME and not text.isprintable():
        raise _invalid(f"{name} has `{field.name}` {text!r}, not {field.kind.value}")
    return text


def _varint(message: memoryview, position: int) -> tuple[int, int]:
    result = 0
    for shift in range(0, 70, 7):
        if position >= len(message):
            raise _invalid("it is truncated")
        byte = message[position]
        position += 1
        result |= (byte & 0x7F) << shift
        if byte < 0x80:
            if (byte == 0 and shift) or result >= 1 << 64:
                raise _invalid("it has a number that is written in more bytes than it needs")
            return result, position
    raise _invalid("it has a number of more than 64 bits")


def _invalid(problem: str) -> ModelInvalid:
    return ModelInvalid("file", f"can't be read as a scene: {problem}")

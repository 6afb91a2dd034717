"""Parse JSON of untrusted files, with limits on length, depth, numbers and texts."""

import json
import math
import re
from typing import Any

MAX_CHARACTERS = 1 << 18
MAX_DEPTH = 16
MAX_DIGITS = 15
"""Limit of digits in an integer, which a double represents exactly."""
MAX_TEXT = 2000
"""Limit of characters in a text value."""

_TOKENS = re.compile(r'"(?:[^"\\]|\\.?)*(?:"|$)|[\[{]|[\]}]', re.DOTALL)


def parse(text: str, max_characters: int = MAX_CHARACTERS) -> Any:
    """Return parsed values with printable texts and finite numbers. Raises ValueError with the reason otherwise."""
    if len(text) > max_characters:
        raise ValueError(f"it has {len(text):,} characters, more than {max_characters:,}")
    _check_depth(text)
    value = json.loads(
        text, parse_int=_integer, parse_float=_decimal, parse_constant=_decimal, object_pairs_hook=_object
    )
    _check_texts(value)
    return value


def _check_depth(text: str) -> None:
    depth = 0
    for token in _TOKENS.finditer(text):
        depth += {"[": 1, "{": 1, "]": -1, "}": -1}.get(token[0], 0)
        if depth > MAX_DEPTH:
            raise ValueError(f"it is nested more than {MAX_DEPTH} deep")


def _integer(digits: str) -> int:
    if len(digits.lstrip("-")) > MAX_DIGITS:
        raise ValueError(f"an integer has {len(digits):,} digits, more than {MAX_DIGITS}")
    return int(digits)


def _decimal(digits: str) -> float:
    number = float(digits)
    if not math.isfinite(number):
        raise ValueError(f"{digits[:20]} isn't a finite number")
    return number


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    result = dict(pairs)
    if len(result) != len(pairs):
        raise ValueError("an object has a duplicate key")
    return result


def _check_texts(value: Any) -> None:
    if isinstance(value, str):
        if len(value) > MAX_TEXT or not value.isprintable():
            raise ValueError(f"{value[:50]!r} isn't printable text of at most {MAX_TEXT:,} characters")
    elif isinstance(value, list):
        for each in value:
            _check_texts(each)
    elif isinstance(value, dict):
        for key, each in value.items():
            _check_texts(key)
            _check_texts(each)

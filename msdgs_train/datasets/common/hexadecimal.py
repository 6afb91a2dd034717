"""Counters in the names of images that are hexadecimal, as `frame_000a`."""

import re
from collections.abc import Sequence
from itertools import pairwise

WORD = re.compile(r"[0-9A-Za-z]+")
MIN_VALUES = 3


def as_decimal(names: Sequence[str]) -> list[str]:
    """The names with hexadecimal counters as decimal numbers. A counter is a word that counts on: at least half of the
    numbers from its first to its last occur, some with letters and some without."""
    words = [list(WORD.finditer(name)) for name in names]
    if len(set(map(len, words))) != 1:
        return list(names)
    result = list(names)
    for column in reversed(list(zip(*words, strict=True))):  # from the last, as their lengths change
        for index, (match, number) in enumerate(zip(column, _decimal([match[0] for match in column]), strict=True)):
            result[index] = result[index][: match.start()] + number + result[index][match.end() :]
    return result


def _decimal(words: list[str]) -> list[str]:
    low, high = min(words), max(words)
    before = next((place for place, (one, two) in enumerate(zip(low, high, strict=False)) if one != two), len(low))
    digits = [word[before:] for word in words]
    if not any(all(re.fullmatch(kind, each) for each in digits) for kind in ("[0-9a-f]+", "[0-9A-F]+")):
        return words
    values = sorted({int(each, 16) for each in digits})
    if len(values) < MIN_VALUES or len({each.isdecimal() for each in digits}) == 1:
        return words
    steps = [two - one for one, two in pairwise(values)]
    step = min(steps)
    if any(each % step for each in steps) or sum(steps) > 2 * step * len(values):
        return words
    return [f"{word[:before]}{int(each, 16)}" for word, each in zip(words, digits, strict=True)]

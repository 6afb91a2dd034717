"""The numbers in the names of images, as fields that all names have.

A number is an integer, a decimal (`t_0.25`), a date with or without a clock (`IMG_20240131_235958_123`), a clock
(`00-01-02.500`) or an epoch (`1706745600123`). All names decide together: a form that doesn't fit all of them, or that
would join a grid of two numbers (`cam1.0001`), is read as separate numbers.
"""

import itertools
import math
import re
from collections.abc import Iterable, Sequence
from datetime import date
from fractions import Fraction
from typing import NamedTuple

DATE = r"(?:19|20)\d\d(?P<{0}>[-_.:]?)(?:0[1-9]|1[0-2])(?P={0})(?:0[1-9]|[12]\d|3[01])"
BETWEEN = r"(?:[-_.]*T?[-_.]*|[-_.\s]+|\s+at\s+)"
CLOCK = r"(?:[01]\d|2[0-3])[-_.:h]?[0-5]\d[-_.:m]?[0-5]\d"
SUBSECOND = r"(?:\d{9}|\d{6}|\d{3})(?!\d)"
HALF_DAY = r"(?:\s?[AaPp][Mm]\b)?"
DAY = 86_400
"""Seconds."""
SIGN = r"(?:(?:(?<![\w.)-])|(?<=_))-)?"
FORMS = {
    "stamp_fraction": rf"(?<!\d){DATE.format('dash')}{BETWEEN}{CLOCK}[-_]?{SUBSECOND}",
    "stamp": rf"(?<!\d){DATE.format('hyphen')}(?:{BETWEEN}{CLOCK}(?:[.,]\d+)?{HALF_DAY})?(?!\d)",
    "epoch": r"(?<!\d)1\d{9}(?:\d{9}|\d{6}|\d{3})?(?!\d)(?:\.\d+|[-_]\d{9}(?!\d))?",
    "clock": rf"(?<!\d)(?:[01]\d|2[0-3])[-:.h][0-5]\d[-:.m][0-5]\d(?:[.,]\d+)?{HALF_DAY}(?!\d)",
    "decimal": rf"{SIGN}\d+\.\d+",
    "number": rf"{SIGN}\d+",
}
"""A pattern for each form of a number; the first that matches counts."""

MIXABLE = ({"stamp_fraction", "stamp"}, {"decimal", "number"})
STAMPS = {"stamp_fraction", "stamp", "epoch"}
CAMERA_WORDS = re.compile(r"(?:.*cam|.*camera|view|vp|gopro|kinect|sensor|lens|device|c|v)s?")
TIME_WORDS = re.compile(r"(?:.*frame|frm|fr|f|.*time|.*timestamp|ts|t|sec|second|ms)s?")
EXTENSION = re.compile(r"\.[A-Za-z]\w*$")


class Token(NamedTuple):
    """A number in a name."""

    text: str
    form: str
    parts: tuple[Fraction, ...]  # their sum is the value, in seconds if the form is not a mere number; () if invalid


class Component(NamedTuple):
    """A folder or the stem of a name: its numbers, and the texts before, between and after them."""

    texts: tuple[str, ...]
    tokens: tuple[Token, ...]


class Field(NamedTuple):
    """A number that all names have."""

    tokens: tuple[Token, ...]
    words: frozenset[str]  # those right before the number, in lower case
    texts: tuple[tuple[str, ...], ...]  # of the folder or stem that it is in
    pattern: str  # a regular expression that finds it in the first name, as its group

    @property
    def values(self) -> tuple[Fraction, ...]:
        return tuple(sum(token.parts, Fraction(0)) for token in self.tokens)

    def is_called(self, pattern: re.Pattern[str]) -> bool:
        """Whether a word before the number is of a kind."""
        return any(pattern.fullmatch(word) for word in self.words)


def read_fields(names: Sequence[str]) -> list[Field]:
    """The numbers that all names have, from the last one on, with those in folders; `/` separates folders."""
    forms = list(FORMS)
    while True:
        fields = list(_fields([_components(name, forms) for name in names]))
        unsound = [form for field in fields if (form := _unsound_form(field))]
        if not unsound:
            return fields
        forms.remove(unsound[0])


def parse_value(text: str) -> Fraction | None:
    """The number, date and clock, or clock that a text is, in seconds if it is not a mere number; None if it is none.

    Unlike in a name, `_` and `:` may separate hours, minutes and seconds, and hours may be left out.
    """
    for form, pattern in FORMS.items():
        if re.fullmatch(pattern, text):
            return sum(parts, Fraction(0)) if (parts := _parts(form, text)) else None
    clock = re.fullmatch(r"(?:(\d+)[-_:.h])?(\d+)[-_:m](\d+(?:\.\d+)?)s?", text)
    return sum(map(_sixtieths, clock.groups("0"), (3600, 60, 1)), Fraction(0)) if clock else None


def _sixtieths(text: str, unit: int) -> Fraction:
    return Fraction(text) * unit


def natural_order(name: str) -> list[tuple[int, str]]:
    """A sorting key that orders numbers by value, with or without leading zeros."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name)]


def _components(name: str, forms: Sequence[str]) -> list[Component]:
    finder = re.compile("|".join(f"(?P<{form}>{FORMS[form]})" for form in forms))
    return [_component(part, finder) for part in EXTENSION.sub("", name).split("/")]


def _component(text: str, finder: re.Pattern[str]) -> Component:
    texts, tokens, end = [], [], 0
    for match in finder.finditer(text):
        form = next(form for form in FORMS if match.groupdict().get(form) is not None)
        texts.append(text[end : match.start()])
        tokens.append(Token(match[0], form, _parts(form, match[0])))
        end = match.end()
    return Component((*texts, text[end:]), tuple(tokens))


def _parts(form: str, text: str) -> tuple[Fraction, ...]:
    if form in ("decimal", "number"):
        whole, _, fraction = text.partition(".")
        sign = "-" * text.startswith("-")
        return (Fraction(int(whole)), *([Fraction(f"{sign}0.{fraction}")] if fraction else []))
    digits = "".join(re.findall(r"\d", text))
    if form == "epoch":
        size = len(re.match(r"\d+", text)[0])  # type: ignore[index]
        return (Fraction(int(digits), 10 ** (len(digits) - 10)),) if size else ()
    days = 0
    if form != "clock":
        try:
            days = date(int(digits[:4]), int(digits[4:6]), int(digits[6:8])).toordinal()
        except ValueError:
            return ()
        digits = digits[8:].ljust(6, "0")
    hours, seconds, fraction = int(digits[:2]), int(digits[4:6]), Fraction(f"0.{digits[6:] or 0}")
    half = text[-2:].lower()
    if half in ("am", "pm"):
        hours = hours % 12 + 12 * (half == "pm")
    minutes = Fraction(DAY * days + 3600 * hours + 60 * int(digits[2:4]))
    return (minutes, seconds + fraction) if form == "clock" else (minutes + seconds, fraction)


def _fields(rows: list[list[Component]]) -> Iterable[Field]:
    """Components are counted from the last, numbers in them from both ends if not all names have as many."""
    for place in range(-1, -1 - min(map(len, rows)), -1):
        components = [row[place] for row in rows]
        counts = {len(component.tokens) for component in components}
        least = min(counts)
        for index in [*range(-1, -1 - least, -1), *(range(least) if len(counts) > 1 else [])]:
            yield Field(
                tuple(component.tokens[index] for component in components),
                frozenset(word for row in rows for word in _words(row, place, index)),
                tuple(component.texts for component in components),
                _pattern(rows, place, index),
            )


def _words(row: list[Component], place: int, index: int) -> list[str]:
    """The word before a number, or that of the folder above; that before a letter without a meaning: `camera_B1`."""
    component = row[place]
    index %= len(component.tokens)
    before = component.texts[index]
    if index == 0 and not before and len(row) > -place:
        before = row[place - 1].texts[-1]
    words = re.findall(r"[^\W\d_]+", before.lower())
    has_meaning = words and (len(words[-1]) > 1 or words[-1] in "cvft")
    return words[-1:] if has_meaning else words[-2:-1]


def _pattern(rows: list[list[Component]], place: int, index: int) -> str:
    """The beginning of the first name up to the number, with `\\D*` for texts that aren't the same in all names."""
    parts = []
    for k in range(-min(map(len, rows)), place + 1):
        texts, tokens = rows[0][k]
        last = index % len(tokens) if k == place else len(tokens)
        for i, text in enumerate(texts[: last + 1]):
            is_same = all(row[k].texts[i : i + 1] == (text,) for row in rows)
            parts.append(_literal(text) if is_same else r"\D*")
            if i < len(tokens):
                number = re.sub(r"\d+", r"\\d+", _literal(tokens[i].text))
                parts.append(f"({number})" if (k, i) == (place, last) else number)
        parts.append("/")
    start = "^" if len(set(map(len, rows))) == 1 else "(?:^|/)"
    return start + "".join(parts[:-1])


def _literal(text: str) -> str:
    return re.sub(r"([.^$*+?{}\[\]\\|()])", r"\\\1", text)


def _unsound_form(field: Field) -> str | None:
    """The form of a field that can't be meant, since not all names have it, or since it joins separate numbers."""
    forms = {token.form for token in field.tokens}
    if len(forms) > 1 and not any(forms <= mixable for mixable in MIXABLE):
        return next(form for form in FORMS if form in forms)
    form = next(form for form in FORMS if form in forms)
    if any(not token.parts for token in field.tokens):
        return form
    if form == "decimal":
        if field.is_called(TIME_WORDS):
            return None
        fractions = [token.text.partition(".")[2] for token in field.tokens]
        counts_on = len(set(map(len, fractions))) > 1 and any(len(f) > 1 and f.endswith("0") for f in fractions)
        if counts_on or field.is_called(CAMERA_WORDS):  # take.9, take.10
            return form
    return form if _is_grid([token.parts for token in field.tokens]) else None


def _is_grid(parts: Sequence[tuple[Fraction, ...]]) -> bool:
    """Whether numbers of two parts, such as 1.0001, 1.0002, 2.0001, 2.0002, are rather two numbers: nearly all
    combinations occur, and any two numbers that differ in the first part are further apart than neighbours that share
    it."""
    pairs = sorted({(*part, Fraction(0))[:2] for part in parts})
    first, second = (len(set(column)) for column in zip(*pairs, strict=True))
    if min(first, second) == 1 or 4 * len(pairs) < 3 * first * second:
        return False
    gaps = {True: [], False: []}
    for one, other in itertools.pairwise(pairs):
        gaps[one[0] == other[0]].append(sum(other) - sum(one))
    return min(gaps[False], default=math.inf) > max(gaps[True], default=math.inf)

"""The numbers in the names of images, as fields that all names have.

A number is an integer, a decimal (`t_0.25`, `t0p25`, `t_2.5e-05`), a date with or without a clock
(`IMG_20240131_235958_123`), a clock (`00-01-02.500`), a time in units (`59s` beside `1m02s500ms`) or an epoch
(`1706745600123`). All names decide together: a form that doesn't fit all of them, or that would join a grid of two
numbers (`cam1.0001`), is read as separate numbers.
"""

import itertools
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from datetime import date
from fractions import Fraction
from operator import mul
from typing import NamedTuple

YEAR, MONTH, DAY_OF_MONTH = r"(?:19|20)\d\d", r"(?:0[1-9]|1[0-2])", r"(?:0[1-9]|[12]\d|3[01])"
HOUR, SIXTY = r"(?:[01]\d|2[0-3])", r"[0-5]\d"
DATE = (
    rf"(?<!\d)(?:{YEAR}(?P<{{0}}>[-_.:]?){MONTH}(?P={{0}}){DAY_OF_MONTH}"
    rf"|{DAY_OF_MONTH}(?P<{{0}}b>[-_.]){MONTH}(?P={{0}}b){YEAR})"
)
BETWEEN = r"(?:[-_.]*T?[-_.]*|[-_.\s]+|\s+at\s+)"
CLOCK = rf"(?:{HOUR}(?P<{{0}}>[-_.:]?){SIXTY}(?P={{0}}){SIXTY}|{HOUR}h{SIXTY}m{SIXTY})"
AFTER_DATE = rf"(?:{CLOCK}|(?<!\d)\d(?P<{{0}}b>[-_.:]){SIXTY}(?P={{0}}b){SIXTY})"
MINUTES = rf"{HOUR}[-_.:h]?{SIXTY}"
TO_MINUTES_OR_MORE = rf"(?:{AFTER_DATE.format('colon2')}(?:[.,]\d+)?|{MINUTES})"
SUBSECOND = r"(?:\d{9}|\d{6}|\d{3})(?!\d)"
HALF_DAY = r"(?:\s?[AaPp][Mm]\b)?"
SECONDS = r"\d+(?:[.,]\d+)?"
UNITS = (
    rf"(?:(?P<h>\d+)h)?(?:(?P<m>\d+)m(?!s))?(?:(?P<s>{SECONDS})s)?"
    r"(?:(?P<ms>\d+)ms|(?<=s)(?P<f>\d{3}))?(?![A-Za-z\d])"
)
DAY = 86_400
"""Seconds."""
MINUS = "\u2212-"
SIGNS = f"+{MINUS}"
SIGN = rf"(?:(?:(?<![\w.){MINUS}])|(?<=_))[{SIGNS}])?"
FORMS = {
    "stamp_fraction": rf"{DATE.format('dash1')}{BETWEEN}{AFTER_DATE.format('colon1')}[-_s]?{SUBSECOND}",
    "stamp": rf"{DATE.format('dash2')}(?:{BETWEEN}{TO_MINUTES_OR_MORE}{HALF_DAY})?(?!\d)",
    "epoch": r"(?<!\d)1\d{9}(?:\d{9}|\d{6}|\d{3})?(?!\d)(?:\.\d+|[-_]\d{9}(?!\d))?",
    "clock": rf"(?<!\d)(?!\d+_\d){CLOCK.format('colon3')}(?:[.,]\d+|s{SUBSECOND})?{HALF_DAY}(?!\d)",
    "units": rf"(?<!\d)(?=\d+[hm]{SECONDS}m?[hms]|{SECONDS}s\d|\d+ms){UNITS}",
    "unit": rf"(?<!\d)(?:\d+[hm]|{SECONDS}s)(?![A-Za-z\d])",
    "scientific": rf"{SIGN}{SECONDS}[eE][-+]\d{{2,3}}(?!\d)",
    "point": rf"{SIGN}\d+pt?\d+(?![A-Za-z])",
    "decimal": rf"{SIGN}\d+[.,]\d+",
    "number": rf"{SIGN}\d+",
}
"""A pattern for each form of a number; the first that matches counts."""

DECIMALS = {"scientific", "point", "decimal"}
MERE = {*DECIMALS, "number"}
MIXABLE = ({"stamp_fraction", "stamp"}, {"units", "unit"}, MERE)
STAMPS = {"stamp_fraction", "stamp", "epoch", "clock", "units", "unit"}
CAMERA_WORDS = re.compile(r"(?:.*cam|.*camera|view|gopro|kinect|sensor|lens|device|c)s?")
FRAME_WORDS = re.compile(r"(?:.*frame|frm|fr|f)s?")
TIME_WORDS = re.compile(r"(?:.*time|.*timestamp|ts|t|sec|second|ms)s?")
EXTENSION = re.compile(r"\.[A-Za-z]\w*$")


Number = int | Fraction
"""Exact, also if it has the 19 digits of nanoseconds since 1970."""


class Token(NamedTuple):
    """A number in a name."""

    text: str
    form: str
    parts: tuple[Number, ...]  # their sum is the value, in seconds if the form is not a mere number; () if invalid

    @property
    def is_date(self) -> bool:
        """Whether it is a date without a clock."""
        return self.form == "stamp" and len(re.sub(r"\D", "", self.text)) == 8


class Component(NamedTuple):
    """A folder or the stem of a name: its numbers, and the texts before, between and after them."""

    texts: tuple[str, ...]
    tokens: tuple[Token, ...]


class Field(NamedTuple):
    """A number that all names have."""

    values: tuple[Number, ...]
    tokens: tuple[Token, ...]
    words: frozenset[str]  # those right before the number, in lower case
    texts: tuple[tuple[str, ...], ...]  # of the folder or stem that it is in
    pattern: str | None  # a regular expression that finds it in the first name, as its group

    @property
    def is_stamp(self) -> bool:
        """Whether it is a date, a clock or an epoch."""
        return self.tokens[0].form in STAMPS

    def is_called(self, pattern: re.Pattern[str]) -> bool:
        """Whether it is a mere number after a word of a kind."""
        return not self.is_stamp and any(pattern.fullmatch(word) for word in self.words)


def read_fields(names: Sequence[str], *, may_separate: bool = True) -> list[Field]:
    """The numbers that all names have, from the last one on, with those in folders; `/` separates folders.

    `may_separate`: a hyphen that all names have before a number is no minus.
    """
    forms = list(FORMS)
    uneven = _uneven([_components(name, ["number"]) for name in names])
    while True:
        rows = _with_signs([_components(name, forms) for name in names])
        rows = _without_separators(rows) if may_separate else rows
        fields = list(_fields(rows))
        unsound = [_first_form(row[place].tokens for row in rows) for place in _uneven(rows) - uneven]
        unsound += [form for field in fields if (form := _unsound_form(field))]
        if not unsound:
            return fields
        forms.remove(unsound[0])


def read_values(texts: Sequence[str]) -> list[Number | None]:
    """The number, date or clock that each text is, in seconds if it is not a mere number; None if it is none.

    Unlike in names, `_` may separate hours, minutes and seconds, and hours may be left out.
    """
    fields = read_fields(texts, may_separate=False)
    if len(fields) == 1 and all(token.text == text for token, text in zip(fields[0].tokens, texts, strict=True)):
        return list(fields[0].values)
    clocks = [re.fullmatch(r"(?:(?:(\d+)[-_:.h])?(\d+)[-_:m])?(\d+(?:\.\d+)?)s?", text) for text in texts]
    return [clock and sum(map(mul, map(Fraction, clock.groups("0")), (3600, 60, 1))) for clock in clocks]


def natural_order(name: str) -> list[tuple[int, str]]:
    """A sorting key that orders numbers by value, with or without leading zeros."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name)]


def _components(name: str, forms: Sequence[str]) -> list[Component]:
    finder = re.compile("|".join(f"(?P<{form}>{FORMS[form]})" for form in forms))
    return [_component(part, finder) for part in EXTENSION.sub("", name).split("/")]


def _component(text: str, finder: re.Pattern[str]) -> Component:
    texts, tokens, end = [], [], 0
    for match in finder.finditer(text):
        form = match.lastgroup or "number"
        texts.append(text[end : match.start()])
        tokens.append(Token(match[0], form, _parts(form, match[0])))
        end = match.end()
    return Component((*texts, text[end:]), tuple(tokens))


def _with_signs(rows: list[list[Component]]) -> list[list[Component]]:
    """With signs in numbers, where the same text without one, or with another, is before others (`frame-1`, `frame0`)
    in the same place."""
    places = [(place - len(row), each) for row in rows for place, each in enumerate(row)]
    before = {(place, i, text) for place, each in places for i, text in enumerate(each.texts)}

    def signed(place: int, component: Component) -> Component:
        texts, tokens = list(component.texts), list(component.tokens)
        for i, (text, token) in enumerate(zip(component.texts, component.tokens, strict=False)):
            stem, sign = text[:-1], text[-1:]
            others = [stem, *(stem + other for other in SIGNS if other != sign)]
            if sign and sign in SIGNS and token.form in MERE and any((place, i, each) in before for each in others):
                texts[i], factor = stem, -1 if sign in MINUS else 1
                tokens[i] = Token(sign + token.text, token.form, tuple(factor * part for part in token.parts))
        return Component(tuple(texts), tuple(tokens))

    return [[signed(place - len(row), each) for place, each in enumerate(row)] for row in rows]


def _without_separators(rows: list[list[Component]]) -> list[list[Component]]:
    """With hyphens in the texts before the numbers, where all after such a text have one; after `=` they are minus."""
    after = [
        (text, token) for row in rows for each in row for text, token in zip(each.texts, each.tokens, strict=False)
    ]
    signed = {text for text, token in after if not token.text.startswith(tuple(MINUS)) or text.endswith("=")}

    def unsigned(component: Component) -> Component:
        texts, tokens = list(component.texts), list(component.tokens)
        for index, (text, token) in enumerate(zip(component.texts, component.tokens, strict=False)):
            if text not in signed:
                texts[index] = text + token.text[0]
                tokens[index] = Token(token.text[1:], token.form, tuple(-part for part in token.parts))
        return Component(tuple(texts), tuple(tokens))

    return [[unsigned(component) for component in row] for row in rows]


def _parts(form: str, text: str) -> tuple[Number, ...]:
    if form in MERE:
        number = Fraction(re.sub(r"pt?|,", ".", text.replace(MINUS[0], "-")))
        whole = int(number)
        return (whole,) if form == "number" else (whole, number - whole)
    if form in ("units", "unit") and (found := re.fullmatch(UNITS, text)):
        hours, minutes, seconds = (Fraction(found[unit].replace(",", ".")) if found[unit] else 0 for unit in "hms")
        return 3600 * hours + 60 * minutes + seconds, Fraction(int(found["f"] or found["ms"] or 0), 1000)
    digits = re.sub(r"\D", "", re.sub(r"(?<!\d)\d(?=[-_.:]\d\d[-_.:]\d\d)", r"0\g<0>", text))
    if form == "epoch":
        return (Fraction(int(digits), 10 ** (len(digits) - 10)),)
    if re.match(r"\d\d\D", text) and form != "clock":  # day, month, year
        digits = digits[4:8] + digits[2:4] + digits[:2] + digits[8:]
    days = 0
    if form != "clock":
        try:
            days = date(int(digits[:4]), int(digits[4:6]), int(digits[6:8])).toordinal()
        except ValueError:
            return ()
        digits = digits[8:].ljust(6, "0")
    hours, seconds, fraction = int(digits[:2]), int(digits[4:6]), Fraction(f"0.{digits[6:]}") if digits[6:] else 0
    half = text[-2:].lower()
    if half in ("am", "pm"):
        hours = hours % 12 + 12 * (half == "pm")
    minutes = DAY * days + 3600 * hours + 60 * int(digits[2:4])
    if form == "stamp_fraction":
        return minutes + seconds, fraction
    return (minutes, seconds + fraction) if form == "clock" else (minutes + seconds + fraction,)


def _fields(rows: list[list[Component]]) -> Iterator[Field]:
    """Components are counted from the last, and numbers in them, too; from both ends if not all names have as many, but
    then only those that have one form in all names."""
    uneven = _uneven(rows)
    for place in range(-1, -1 - min(map(len, rows)), -1):
        components = [row[place] for row in rows]
        least, is_even = min(len(component.tokens) for component in components), place not in uneven
        for index in [*range(-1, -1 - least, -1), *(() if is_even else range(least))]:
            tokens = tuple(component.tokens[index] for component in components)
            if is_even or _is_mixable(tokens):
                words = frozenset(word for row in rows for word in _words(row, place, index))
                texts = tuple(component.texts for component in components)
                yield Field(
                    tuple(sum(token.parts) for token in tokens), tokens, words, texts, _pattern(rows, place, index)
                )


def _words(row: list[Component], place: int, index: int) -> list[str]:
    """The word before a number, or that of the folder above; that before a letter without a meaning: `camera_B1`."""
    component = row[place]
    index %= len(component.tokens)
    before = component.texts[index]
    if index == 0 and not before and len(row) > -place:
        before = row[place - 1].texts[-1]
    words = re.findall(r"[^\W\d_]+", before.lower())
    has_meaning = words and (len(words[-1]) > 1 or words[-1] in "cft")
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


def _uneven(rows: list[list[Component]]) -> set[int]:
    """The places of the components in which names have different counts of numbers."""
    places = range(-1, -1 - min(map(len, rows)), -1)
    return {place for place in places if len({len(row[place].tokens) for row in rows}) > 1}


def _first_form(tokens: Iterable[Iterable[Token]]) -> str:
    found = {token.form for each in tokens for token in each}
    return next(form for form in FORMS if form in found)


def _is_mixable(tokens: Sequence[Token]) -> bool:
    """Whether numbers have one form, or forms that may replace each other."""
    forms = {token.form for token in tokens}
    return len(forms) == 1 or any(forms <= mixable for mixable in MIXABLE)


def _unsound_form(field: Field) -> str | None:
    """The form of a field that can't be meant, since not all names have it, or since it joins separate numbers."""
    form = _first_form([field.tokens])
    if not (_is_mixable(field.tokens) and all(token.parts for token in field.tokens)):
        return form
    if form == "clock" and all(re.match(r"00\d{4}", token.text) for token in field.tokens):  # a number of six digits
        return form
    if form == "unit" and len({token.text[-1] for token in field.tokens}) == 1:  # a mere number
        return form if len(set(field.values)) > 1 else None
    if form in ("point", "decimal"):
        if field.is_called(TIME_WORDS) or field.is_called(FRAME_WORDS):
            return None
        fractions = [re.sub(r"\D?\d+\D*", "", token.text, count=1) for token in field.tokens]
        counts_on = len(set(map(len, fractions))) > 1 and any(len(f) > 1 and f.endswith("0") for f in fractions)
        if counts_on or field.is_called(CAMERA_WORDS):  # take.9, take.10; cam1.0001
            return form
    return form if _is_grid([token.parts for token in field.tokens]) else None


def _is_grid(parts: Sequence[tuple[Number, ...]]) -> bool:
    """Whether numbers of two parts, such as 1.0001, 1.0002, 2.0001, 2.0002, are rather two numbers: nearly all
    combinations occur, and any two numbers that differ in the first part are further apart than neighbours that share
    it."""
    pairs = sorted({(*part, 0)[:2] for part in parts})
    first, second = (len(set(column)) for column in zip(*pairs, strict=True))
    if min(first, second) == 1 or 4 * len(pairs) < 3 * first * second:
        return False
    gaps = {True: [], False: []}
    for one, other in itertools.pairwise(pairs):
        gaps[one[0] == other[0]].append(sum(other) - sum(one))
    return min(gaps[False], default=math.inf) > max(gaps[True], default=math.inf)

"""Times of images from their names, which are read together.

The time is the number that varies and never repeats among the images of one camera. Where several numbers may be it,
cameras that stand still decide, then dates and epochs, words such as `cam` and `frame`, and cameras with different
lenses. If more than one remains, the names are ambiguous.
"""

import re
from collections.abc import Hashable, Sequence
from fractions import Fraction
from itertools import pairwise
from typing import Literal, NamedTuple

from msdgs_train.datasets.common.name_fields import (
    CAMERA_WORDS,
    DAY,
    DECIMALS,
    EXTENSION,
    FRAME_WORDS,
    TIME_WORDS,
    Field,
    Number,
    Token,
    natural_order,
    read_fields,
    read_values,
)
from msdgs_train.datasets.common.name_spellings import plain

PHOTO_WORDS = re.compile(r"img|dsc[nf]?|mg|imgp|sam|dji|gopr|photo|pict?")
"""Words before the numbers that a camera gives to its photos."""
SECOND_WORDS = re.compile(r"sec(?:ond)?s?")
RECORDING_WORDS = re.compile(r"(?:take|clip|scene|part|chapter|video|vid|shot|seq|sequence|session|rec|g[xhls]|mvi)s?")
"""Words before the number of a recording. If it varies, frames may start again in each."""

Times = tuple[Number, ...]


class Reading(NamedTuple):
    """One way to read the names."""

    times: Times  # in the unit of the names
    texts: tuple[str, ...]  # the times as the names have them
    pattern: str | None  # a regular expression that finds them, if a simple one does
    called: Literal["camera", "photo"] | None  # what the words before the number say, if not a time
    is_in_seconds: bool  # whether the names say so


class NameWithoutTime(Exception):
    """A name has no number where others have one; the argument is that name."""


def readings(names: Sequence[str], poses: Sequence[Hashable], lenses: Sequence[Hashable]) -> list[Reading]:
    """The likely times of names; several readings if they are ambiguous, none if no number varies but a camera's.

    `poses` are equal for images taken from the same place, `lenses` for those that may be of the same camera. Raises
    `NameWithoutTime`.
    """
    everywhere = read_fields(plain(names))
    if not everywhere and len(names) > 1:
        raise NameWithoutTime(next((name for name in names if not re.search(r"\d[^/]*$", name)), names[0]))
    fields = _dated([field for field in everywhere if len(set(field.values)) > 1])
    steps = (
        _merged,
        _without_labels,
        lambda kept: _without_repeats(kept, poses),
        _finest,
        _named,
        lambda kept: _without_repeats(kept, lenses) if len(set(lenses)) > 1 and not _may_restart(kept) else kept,
    )
    for step in steps:
        if len(fields) > 1:
            fields = step(fields) or fields
    if len(fields) == 1 and fields[0].is_stamp:
        cameras = poses if len(set(poses)) < len(poses) else lenses
        fields += _in_seconds(fields[0], everywhere, cameras)
    found = [_reading(names, field) for field in fields]
    if [reading.called for reading in found] == ["camera"]:
        if len(set(poses)) < len(poses):  # one camera, that stands still for a while
            return [found[0]._replace(called=None)]
        if len(everywhere) > 1:  # the others are the same in all names
            return []
    return found


def times_in_order(names: Sequence[str]) -> Times:
    """The place of each file's name in their natural order; those that differ in the folder alone share a place."""
    files = [EXTENSION.sub("", name.rsplit("/", 1)[-1]) for name in plain(names)]
    places = {file: place for place, file in enumerate(sorted(set(files), key=natural_order))}
    return tuple(places[file] for file in files)


def times_by_pattern(names: Sequence[str], expression: re.Pattern[str]) -> Times:
    """The numbers, dates and clocks that `time_group` finds. Raises `NameWithoutTime`."""
    found = [expression.search(name) for name in names]
    group = time_group(expression)
    times = read_values(plain([match[group] or "" if match and group else "" for match in found]))
    for name, time in zip(names, times, strict=True):
        if time is None:
            raise NameWithoutTime(name)
    return tuple(time for time in times if time is not None)


def time_group(expression: re.Pattern[str]) -> str | int | None:
    """The group of the time: the one named `time`, or the only one."""
    if "time" in expression.groupindex:
        return "time"
    return 1 if expression.groups == 1 else None


def _in_seconds(stamp: Field, fields: list[Field], cameras: Sequence[Hashable]) -> list[Field]:
    """The number after a stamp that one camera has several times, if it tells them apart: the stamp isn't all of the
    time then, or the number is that of another camera."""
    moments = list(zip(cameras, stamp.values, strict=True))
    if len(set(moments)) == len(moments):
        return []
    after = [field for field in fields[: _place(stamp, fields)] if field.texts == stamp.texts]
    numbers = [field for field in after if not field.is_stamp and not field.is_called(CAMERA_WORDS)]
    return [field for field in numbers if len(set(zip(moments, field.values, strict=True))) == len(moments)][:1]


def _place(stamp: Field, fields: list[Field]) -> int:
    return next(place for place, field in enumerate(fields) if field.is_stamp and field.texts == stamp.texts)


def _dated(fields: list[Field]) -> list[Field]:
    """With the only date, of a folder for example, added to the only clock."""
    dates = [field for field in fields if all(token.is_date for token in field.tokens)]
    clocks = [field for field in fields if field.tokens[0].form == "clock"]
    if len(dates) != 1 or len(clocks) != 1:
        return fields
    tokens = [
        Token(f"{date.text} {clock.text}", "stamp", date.parts + clock.parts)
        for date, clock in zip(dates[0].tokens, clocks[0].tokens, strict=True)
    ]
    values = tuple(sum(token.parts) for token in tokens)
    dated = clocks[0]._replace(values=values, tokens=tuple(tokens), pattern=None)
    return [dated, *(field for field in fields if field not in (*dates, *clocks))]


def _merged(fields: list[Field]) -> list[Field]:
    """Without fields that say the same again, such as a folder's number in the names of its files."""
    kept: dict[Times, Field] = {}
    for field in fields:
        first, last = min(field.values), max(field.values)
        key = tuple(Fraction(value - first, last - first) for value in field.values)
        same = kept.get(key)
        kept[key] = same._replace(words=same.words | field.words) if same else field
    return list(kept.values())


def _without_labels(fields: list[Field]) -> list[Field]:
    """Without numbers that belong to a text, such as `left1` and `right2`."""
    return [field for field in fields if len(set(field.texts)) != len(set(zip(field.texts, field.values, strict=True)))]


def _without_repeats(fields: list[Field], cameras: Sequence[Hashable]) -> list[Field]:
    """Without those that repeat among the images of one camera."""
    return [field for field in fields if len(set(zip(cameras, field.values, strict=True))) == len(cameras)]


def _finest(fields: list[Field]) -> list[Field]:
    """Without those that another one refines, such as the part of a video by frames that count on; and without a
    photo's number beside another one in the same order."""
    return [
        field
        for field in fields
        if not any(
            _grows_with(field, other)
            and (not _grows_with(other, field) or (field.is_called(PHOTO_WORDS) and not other.is_called(PHOTO_WORDS)))
            for other in fields
        )
    ]


def _grows_with(field: Field, other: Field) -> bool:
    """Whether a field is a function of another that never falls."""
    pairs = sorted(set(zip(other.values, field.values, strict=True)))
    return all(one[0] < two[0] and one[1] <= two[1] for one, two in pairwise(pairs))


def _named(fields: list[Field]) -> list[Field]:
    """Dates, clocks and epochs that vary most; else what is called a time, a frame, or at least no camera."""
    fields = [field for field in fields if not field.is_called(CAMERA_WORDS)] or fields
    most = max(len(set(field.values)) for field in fields)
    stamps = [field for field in fields if field.is_stamp and len(set(field.values)) == most]
    if stamps or _may_restart(fields):
        return stamps or fields
    times, frames = ([field for field in fields if field.is_called(words)] for words in (TIME_WORDS, FRAME_WORDS))
    return times or frames or fields


def _may_restart(fields: list[Field]) -> bool:
    """Whether there is a number or date of recordings, in each of which frames may start again."""
    return len(fields) > 1 and any(field.is_stamp or field.is_called(RECORDING_WORDS) for field in fields)


def _reading(names: Sequence[str], field: Field) -> Reading:
    times = field.values
    if field.tokens[0].form == "clock":  # without a date: the day changes in a gap of more than half a day
        ordered = sorted(set(times))
        midnight = next((two for one, two in pairwise(ordered) if two - one > DAY // 2), None)
        if midnight is not None:
            times = tuple(time + DAY * (time < midnight) for time in times)
    texts = tuple(token.text for token in field.tokens)
    pattern = field.pattern if field.pattern and _finds(field.pattern, names, texts) else None
    called = "camera" if field.is_called(CAMERA_WORDS) else "photo" if field.is_called(PHOTO_WORDS) else None
    is_decimal = any(token.form in DECIMALS for token in field.tokens) and not field.is_called(FRAME_WORDS)
    is_in_seconds = field.is_stamp or field.is_called(SECOND_WORDS) or is_decimal
    return Reading(times, texts, pattern, called, is_in_seconds)


def _finds(pattern: str, names: Sequence[str], texts: Sequence[str]) -> bool:
    found = [re.search(pattern, name) for name in names]
    return [match and match[1] for match in found] == list(texts)

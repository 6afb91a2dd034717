"""Which pictures of a video are taken: the sharpest of each interval of time, or those at given times.

Left out are pictures that show nothing (black, or of one color), repeated ones, and intervals all of whose pictures are
blurred compared with their neighbors.
"""

from bisect import bisect
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from msdgs_train.capture.pictures import Picture
from msdgs_train.capture.sharpness import sharpness, thumbnail

BLANK = 8.0
"""Gray values of 255 between the darkest and the brightest parts of a picture that shows nothing."""
REPEATED, SAME = 0.25, 8.0
"""A picture is a copy of the one before, encoded again, if its difference is less than this part of the usual one, and
no part of it differs by more than so many gray values."""
BLURRED = 0.5
"""Sharpness, relative to the upper quartile of neighbors, below which a picture is blurred: Gaussian blur with a
standard deviation of 1.3 pixels, or motion blur of 7 pixels."""
NEIGHBORS = 8
"""Pictures on either side."""
CUT, CUT_RATIO = 0.4, 4.0
"""1 − correlation of two successive pictures at a cut, and its ratio to the median around it."""


class Intervals:
    """Intervals of one length on the common clock. The sharpest picture of each is taken."""

    def __init__(self, start: float, length: float) -> None:
        self._start, self._length = start, length

    def interval(self, picture: Picture, time: float) -> int:
        # of pictures that are exactly at a border, rounding would put some before it
        return picture.index if self._length == 0 else int((time - self._start) / self._length + 1e-6)

    def score(self, sharp: float, time: float) -> float:
        return sharp


class Moments:
    """Intervals around given times, continued on either side. The picture nearest to each time is taken."""

    def __init__(self, times: Sequence[float], length: float, first: float, last: float) -> None:
        before = np.arange(times[0] - length, first - length, -length)[::-1] if length else []
        after = np.arange(times[-1] + length, last + length, length) if length else []
        self._times = [*before, *times, *after]
        self._borders = [(one + two) / 2 for one, two in pairwise(self._times)]

    def interval(self, picture: Picture, time: float) -> int:
        return bisect(self._borders, time)

    def score(self, sharp: float, time: float) -> float:
        return -abs(time - self._times[bisect(self._borders, time)])


@dataclass
class Taken:
    """A picture that was taken."""

    name: str
    time: float
    sharpness: float


@dataclass
class Selection:
    """What was taken of one video, and what was left out."""

    taken: list[Taken] = field(default_factory=list)
    black: int = 0
    repeated: int = 0
    changes: list[tuple[float, float]] = field(default_factory=list)  # time, 1 − correlation with the picture before


def select(
    pictures: Iterable[Picture],
    offset: float,
    moments: Intervals | Moments,
    write: Callable[[Picture], str],
    each: Callable[[], None],
) -> Selection:
    """Take pictures of a video that starts at `offset` on the common clock.

    `write` stores one and returns its name; `each` is called after each picture that was looked at. Two pictures are in
    memory at a time.
    """
    selection, previous, usual = Selection(), None, 0.0
    best: tuple[int, float, Taken, Picture] | None = None

    def store() -> None:
        if best is not None:
            best[2].name = write(best[3])
            selection.taken.append(best[2])

    for picture in pictures:
        each()
        small = thumbnail(picture.grey)
        if np.ptp(np.percentile(small, (1, 99))) < BLANK:
            selection.black += 1
            continue
        if previous is not None:
            difference = small - previous
            change = float(np.sqrt(np.square(difference).mean()))
            if change <= REPEATED * usual and np.abs(difference).max() <= SAME:
                selection.repeated += 1
                continue
            usual = change if usual == 0 else 0.8 * usual + 0.2 * change
            selection.changes.append((offset + picture.time, 1 - _correlation(small, previous)))
        previous = small
        time, sharp = offset + picture.time, sharpness(picture.grey)
        interval, score = moments.interval(picture, time), moments.score(sharp, time)
        if best is None or interval != best[0]:
            store()
        elif score <= best[1]:
            continue
        best = interval, score, Taken("", time, sharp), picture
    store()
    return selection


def blurred(taken: Sequence[Taken]) -> list[Taken]:
    """Those that are blurred compared with their neighbors in time."""
    values = np.array([each.sharpness for each in taken])
    usual = [np.percentile(values[max(0, i - NEIGHBORS) : i + NEIGHBORS + 1], 75) for i in range(len(values))]
    return [each for each, limit in zip(taken, usual, strict=True) if each.sharpness < BLURRED * limit]


def cuts(changes: Sequence[tuple[float, float]]) -> list[float]:
    """Times of the first pictures after cuts: they are unlike the one before, which others around them aren't."""
    values = np.array([change for _, change in changes])
    found = []
    for index, (time, change) in enumerate(changes):
        around = np.delete(values, index)[max(0, index - NEIGHBORS) : index + NEIGHBORS]
        if change > CUT and (around.size == 0 or change > CUT_RATIO * np.median(around)):
            found.append(time)
    return found


def _correlation(one: np.ndarray, two: np.ndarray) -> float:
    one, two = one - one.mean(), two - two.mean()
    return float((one * two).sum() / max(np.sqrt((one**2).sum() * (two**2).sum()), 1e-9))

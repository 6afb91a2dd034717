"""The images that poses are found of, and the pairs of them that are matched."""

from bisect import bisect
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TypeVar

T = TypeVar("T")

OVERLAP = 10
"""Following frames that a frame is matched with; beyond them those at distances of powers of two."""
REVISITS = 24
"""Frames of a moving camera, at even distances, that are all matched with each other: the camera may come back."""
LINKS = 40
"""Frames of a moving camera that are matched with those of another camera."""
KEYFRAMES = 100
"""Frames of a moving camera that a model is made of. Of 300 frames of 1024 pixels these are mapped in 20 seconds, all
in more than ten minutes."""
NEAREST = 2
"""Keyframes before and after another frame that it is matched with."""


@dataclass(frozen=True)
class View:
    """The frame of a moving camera, or the background of a fixed one."""

    name: str
    """Path below its folder."""
    camera: int
    time: float
    """Seconds; 0 for a background."""
    is_background: bool = False


def matched_pairs(views: Sequence[View]) -> list[tuple[str, str]]:
    """Names of the views to match: neighbors, views at even distances, and views of about one time across
    cameras."""
    cameras = _by_camera(views)
    pairs = [pair for own in cameras for pair in _own_pairs(own)]
    pairs += [pair for one, other in combinations(cameras, 2) for pair in _cross_pairs(one, other)]
    return list(dict.fromkeys((first.name, second.name) for first, second in pairs))


def keyframes(views: Sequence[View]) -> list[View]:
    """The views that a model is made of, in their order."""
    chosen = {view for own in _by_camera(views) for view in spread(own, KEYFRAMES)}
    return [view for view in views if view in chosen]


def pairs_with_keyframes(views: Sequence[View], keys: Sequence[View]) -> list[tuple[str, str]]:
    """Names of each view that is not among the keyframes `keys`, and of those of its camera around it."""
    chosen, pairs = set(keys), []
    for own in _by_camera(views):
        places = [index for index, view in enumerate(own) if view in chosen]
        for index, view in enumerate(own):
            if view not in chosen:
                after = bisect(places, index)
                around = places[max(after - NEAREST, 0) : after + NEAREST]
                pairs += [(view.name, own[place].name) for place in around]
    return pairs


def _by_camera(views: Sequence[View]) -> list[list[View]]:
    return [[view for view in views if view.camera == camera] for camera in sorted({view.camera for view in views})]


def _own_pairs(views: Sequence[View]) -> Iterator[tuple[View, View]]:
    distances = [*range(1, OVERLAP + 1)]
    while distances[-1] < len(views):
        distances.append(1 << distances[-1].bit_length())
    for first, view in enumerate(views):
        yield from ((view, views[first + distance]) for distance in distances if first + distance < len(views))
    yield from combinations(spread(views, REVISITS), 2)


def _cross_pairs(one: Sequence[View], other: Sequence[View]) -> Iterator[tuple[View, View]]:
    few, many = sorted((one, other), key=len)
    for view in spread(many, LINKS):
        yield view, min(few, key=lambda candidate: abs(candidate.time - view.time))


def spread(items: Sequence[T], count: int) -> list[T]:
    """At most `count` of the items, two or more, at even distances, with the first and the last."""
    if len(items) <= count:
        return list(items)
    return [items[round(index * (len(items) - 1) / (count - 1))] for index in range(count)]

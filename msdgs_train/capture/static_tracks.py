"""Which features are on what stands still: those whose tracks agree with the epipolar geometry of almost all pairs.

What moves agrees with the geometry of the background in some pairs, by chance or as it moves along epipolar lines, but
seldom in all of them. Frames far apart have few matches of the background, which looks different from there, so that
their geometry may be that of an object that moves: only pairs with many matches have a say.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

MANY = 0.25
"""Matches of a pair that has a say, relative to those of neighboring frames."""
LINKED = 4
"""Frames between the two of a pair whose matches make tracks, at most."""
AGREES = 0.9
"""Part of a track's matches that agree with the geometry of their pairs, if it stands still."""
MIN_MATCHES = 3
"""Of a track that is judged."""


class MatchedPair(NamedTuple):
    """Matches of two images, and which agree with the epipolar geometry of the two."""

    first: int  # row of an image
    second: int
    distance: int | None  # in frames of one camera; None of two cameras
    matches: np.ndarray  # [M, 2] keypoints
    agrees: np.ndarray  # [M] bool

    def only(self, kept: np.ndarray) -> "MatchedPair":
        """With some of the matches, [M] bool."""
        return self._replace(matches=self.matches[kept], agrees=self.agrees[kept])


class Tracks:
    """The keypoints of all images, numbered through, and the tracks that they belong to."""

    def __init__(self, counts: Sequence[int], pairs: Sequence[MatchedPair]) -> None:
        """`counts` has the keypoints of each image."""
        self._starts = np.concatenate([[0], np.cumsum(counts)]).astype(int)
        linked = [self._ends(pair) for pair in pairs if pair.distance is not None and pair.distance <= LINKED]
        ends = np.concatenate([np.empty((0, 2), int), *linked])
        links = coo_matrix((np.ones(len(ends)), ends.T), shape=(self._starts[-1],) * 2)
        self._track = connected_components(links, directed=False)[1]

    def static(self, pairs: Sequence[MatchedPair]) -> np.ndarray:
        """[K] bool: whether a keypoint's track agrees with almost all pairs that have a say."""
        votes, agreeing = np.zeros((2, len(self._track)))
        for pair in _with_a_say(pairs):
            for keypoints in self._ends(pair).T:
                votes += np.bincount(keypoints, minlength=len(votes))
                agreeing += np.bincount(keypoints, pair.agrees, minlength=len(votes))
        votes, agreeing = (np.bincount(self._track, each) for each in (votes, agreeing))
        return ((votes >= 2 * MIN_MATCHES) & (agreeing >= AGREES * votes))[self._track]

    def within(self, kept: np.ndarray, pair: MatchedPair) -> MatchedPair:
        """The matches of a pair whose keypoints are among those kept, [K] bool."""
        return pair.only(np.all(kept[self._ends(pair)], axis=1))

    def of_image(self, row: int) -> slice:
        """The keypoints of an image."""
        return slice(self._starts[row], self._starts[row + 1])

    def _ends(self, pair: MatchedPair) -> np.ndarray:
        return pair.matches + self._starts[[pair.first, pair.second]]


def _with_a_say(pairs: Sequence[MatchedPair]) -> list[MatchedPair]:
    neighbors = [len(pair.matches) for pair in pairs if pair.distance == 1]
    least = MANY * float(np.median(neighbors)) if neighbors else 0.0
    return [pair for pair in pairs if pair.distance is not None and len(pair.matches) >= max(least, 1)]

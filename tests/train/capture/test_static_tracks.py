"""Tracks of features on what stands still are told from those on what moves."""

import numpy as np
import pytest

from msdgs_train.capture.static_tracks import MatchedPair, Tracks

FRAMES, STATIC, MOVING = 12, 300, 200
"""Keypoints of each frame: each has one of every track."""
IS_STATIC = np.arange(STATIC + MOVING) < STATIC


def pairs(random: np.random.Generator, chance: float) -> list[MatchedPair]:
    """Matches of all keypoints of neighbors, fewer the farther frames are apart, of which at distances above 5 only
    those on what moves are left. Geometry is that of what stands still, with which `chance` of the others agree, and
    far away that of what moves."""
    made = []
    for first in range(FRAMES):
        for second in range(first + 1, FRAMES):
            distance = second - first
            seen = random.random(len(IS_STATIC)) < 0.9**distance
            seen &= ~IS_STATIC & (random.random(len(IS_STATIC)) < 0.2) if distance > 5 else True
            agreeing = (random.random(len(IS_STATIC)) < np.where(IS_STATIC, 0.98, chance)) | (distance > 5)
            rows = np.flatnonzero(seen)
            made.append(MatchedPair(first, second, distance, np.stack([rows, rows], axis=1), agreeing[rows]))
    return made


@pytest.mark.parametrize("chance", [0.1, 0.7])
def test_what_agrees_only_at_times_moves(chance: float):
    made = pairs(np.random.default_rng(0), chance)
    tracks = Tracks([len(IS_STATIC)] * FRAMES, made)
    static = tracks.static(made).reshape(FRAMES, -1)
    assert static[:, IS_STATIC].mean() > 0.9
    assert static[:, ~IS_STATIC].mean() < 0.01


def test_matches_are_kept_if_both_ends_are():
    made = pairs(np.random.default_rng(0), 0.5)
    tracks = Tracks([len(IS_STATIC)] * FRAMES, made)
    kept = np.ones(FRAMES * len(IS_STATIC), bool)
    kept[tracks.of_image(3)] = np.arange(len(IS_STATIC)) % 2 == 0
    for pair in made:
        left = tracks.within(kept, pair)
        is_cut = 3 in (pair.first, pair.second)
        even = pair.matches[:, 0] % 2 == 0
        np.testing.assert_array_equal(left.matches, pair.matches[even] if is_cut else pair.matches)
        assert len(left.agrees) == len(left.matches)


def test_views_of_other_cameras_have_no_say():
    """Two cameras see different sides, and their geometry may be any."""
    made = pairs(np.random.default_rng(0), 0.1)
    across = [pair._replace(distance=None, agrees=~pair.agrees) for pair in made]
    tracks = Tracks([len(IS_STATIC)] * FRAMES, made)
    np.testing.assert_array_equal(tracks.static([*made, *across]), tracks.static(made))


def test_without_pairs_nothing_is_known_to_stand_still():
    tracks = Tracks([5, 0, 2], [])
    np.testing.assert_array_equal(tracks.static([]), np.zeros(7, bool))

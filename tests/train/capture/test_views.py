"""Which views a model is made of, and which pairs of them are matched."""

import pytest

from msdgs_train.capture import views
from msdgs_train.capture.views import NEAREST, View, keyframes, matched_pairs, pairs_with_keyframes

MODELED = 5
MOVING = [View(f"a/{frame:02}.png", 0, frame / 10) for frame in range(17)]
FEW = [View(f"b/{frame}.png", 1, frame / 2) for frame in range(3)]
BACKGROUND = View("2.png", 2, 0.0, True)


@pytest.fixture(autouse=True)
def few_keyframes(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(views, "KEYFRAMES", MODELED)


def test_keyframes_are_spread_over_each_camera():
    assert keyframes([*MOVING, *FEW, BACKGROUND]) == [*MOVING[::4], *FEW, BACKGROUND]


def test_other_frames_are_matched_with_keyframes_of_their_camera_around_them():
    views = [*MOVING, *FEW, BACKGROUND]
    pairs = pairs_with_keyframes(views, keyframes(views))
    others = [view.name for view in MOVING if view not in MOVING[::4]]
    assert [*dict.fromkeys(name for name, _ in pairs)] == others
    of_sixth = [key for name, key in pairs if name == MOVING[6].name]
    assert of_sixth == [MOVING[frame].name for frame in (0, 4, 8, 12)]
    of_first = [key for name, key in pairs if name == MOVING[1].name]
    assert of_first == [MOVING[frame].name for frame in (0, 4, 8)]
    assert len(of_sixth) == 2 * NEAREST


def test_without_other_frames_there_are_no_such_pairs():
    assert keyframes(FEW) == FEW
    assert pairs_with_keyframes(FEW, FEW) == []
    assert len(matched_pairs(FEW)) == 3

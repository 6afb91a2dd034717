"""The verdict names what to record differently, and what prevents a scene alone."""

from dataclasses import replace

import pytest

from msdgs_train.capture.measures import Measures
from msdgs_train.capture.verdict import judge, judge_frames

GOOD = Measures(
    cameras=1,
    frames=200,
    available=900,
    seconds=30.0,
    blurred=3,
    cuts=(),
    black=0.0,
    registered=200,
    points=9000,
    method="incremental",
    reprojection_error=0.6,
    parallax=25.0,
    parallax_of_frames=(25.0,) * 200,
    baseline=0.6,
    beyond_rotation=20.0,
    agreement=1.1,
    seen=300.0,
    size=1024,
    moving=0.15,
)


def test_a_good_recording_is_good():
    assert judge_frames(GOOD).level == judge(GOOD).level == "good"
    assert judge(GOOD).text == "good: train on it"


NO_SCENE = {
    "tripod": ({"fixed": 1, "registered": 0, "parallax": 0.0}, "stands still"),
    "pure pan with poses": ({"beyond_rotation": 0.7}, "only turns"),
    "pure pan without poses": ({"registered": 0, "beyond_rotation": 0.7, "parallax": 0.0}, "only turns"),
    "poses of a few points": ({"seen": 5.0}, "5 points"),
    "8 frames": ({"frames": 8, "available": 8, "registered": 8}, "8 frames, of 8"),
    "black": ({"black": 0.8, "registered": 0}, "80% of the recording is black"),
    "cut": ({"registered": 110, "breaks": (4.24,)}, "break off at 4.2 s"),
    "nothing but what moves": ({"registered": 20, "moving": 0.7}, "70% of the image moves"),
    "no texture": ({"registered": 0, "parallax": 0.0}, "0 of 200 frames"),
    "wrong poses": ({"agreement": 0.29}, "29% of what frames have in common"),
    "hardly any parallax": ({"parallax": 0.4}, "0.4°"),
}


@pytest.mark.parametrize(("changes", "words"), NO_SCENE.values(), ids=NO_SCENE)
def test_what_prevents_a_scene_stands_alone(changes: dict, words: str):
    verdict = judge(replace(GOOD, **changes))
    assert verdict.level == "no scene"
    (finding,) = verdict.findings
    assert words in finding.problem
    assert finding.remedy


IMPROVABLE = {
    "three fixed cameras": ({"cameras": 3, "fixed": 3}, "3 cameras that stand still"),
    "few frames": ({"frames": 30, "registered": 30}, "30 frames are few"),
    "blurred": ({"blurred": 100}, "100 of 300 intervals"),
    "some without poses": ({"registered": 150}, "150 of 200"),
    "little parallax": ({"parallax": 3.0}, "3.0°"),
    "large errors": ({"reprojection_error": 2.0}, "2.0 pixels"),
    "much that moves": ({"moving": 0.6}, "60%"),
}


@pytest.mark.parametrize(("changes", "words"), IMPROVABLE.values(), ids=IMPROVABLE)
def test_what_could_be_better_is_said(changes: dict, words: str):
    verdict = judge(replace(GOOD, **changes))
    assert verdict.level == "usable"
    (finding,) = verdict.findings
    assert words in finding.problem


def test_all_that_could_be_better_is_said():
    verdict = judge(replace(GOOD, blurred=100, parallax=3.0))
    assert len(verdict.findings) == 2
    assert len(verdict.text.splitlines()) == 3


@pytest.mark.parametrize("changes", [{"cameras": 6, "fixed": 6, "beyond_rotation": 0.0, "agreement": 0.2},
                                     {"cameras": 3, "fixed": 2, "beyond_rotation": 0.0}])  # fmt: skip
def test_several_fixed_cameras_need_no_motion(changes: dict):
    assert judge(replace(GOOD, **changes)).level == "good"


def test_fixed_cameras_without_poses_are_to_be_closer():
    (finding,) = judge(replace(GOOD, cameras=6, fixed=6, registered=150)).findings
    assert "closer" in finding.remedy


def test_a_cut_that_poses_bridge_is_none():
    assert judge(replace(GOOD, cuts=(4.2,))).level == "good"

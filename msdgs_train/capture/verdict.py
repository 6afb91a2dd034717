"""What a capture is worth, in words: good, or what to record differently.

The limits of rotation, agreement and parallax are where scenes of known truth stop being found, or found well:
`python -m benchmarks.capture.verdicts`, docs/your_scene.md. The others are chosen.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from msdgs_train.capture.measures import Measures

MIN_FRAMES, FEW_FRAMES = 12, 40
"""Frames below which there is no scene, and below which it is rough."""
MAX_BLACK = 0.5
"""Share of the frames in the recordings that are black."""
MIN_REGISTERED, FEW_REGISTERED = 0.5, 0.95
"""Shares of frames with poses."""
MIN_WHOLE = 0.75
"""The same, where poses break off."""
MIN_BEYOND_ROTATION, LEAST_PIXELS = 1 / 1000, 0.65
"""In longer sides of the frames, and in pixels at least, as matches are no better."""
MIN_AGREEMENT = 0.4
"""Of the features of moving cameras that are found again, as observations of points: 0.7 and more with right poses, and
0.3 at most with wrong ones."""
MIN_SEEN = 15
"""Points that a frame sees, for poses that are more than guesses."""
MIN_PARALLAX, LITTLE_PARALLAX = 1.0, 4.0
"""Degrees."""
MUCH_BLURRED = 0.2
"""Share of the intervals."""
MUCH_MOVING = 0.5
"""Share of the image."""
LARGE_ERROR = 1.5
"""Pixels."""
ENOUGH_FIXED = 4
"""Cameras, if all stand still: of three, centers are found with errors of 3 to 27 % of their extent."""

MOVE = "walk around the subject, so that the camera itself moves sideways, by 20° or more as the subject sees it"

TEXTURE = "move slower, in more light, and keep surfaces with texture that stand still in view"

CLOSER = "place the cameras closer to each other, so that neighbors see the same surfaces with texture"


@dataclass(frozen=True)
class Finding:
    """Something to record differently."""

    problem: str
    """What is wrong, with its figures."""
    remedy: str
    prevents: bool
    """Whether no scene can be made."""


@dataclass(frozen=True)
class Verdict:
    """What a capture is worth."""

    findings: tuple[Finding, ...]

    @property
    def level(self) -> Literal["good", "usable", "no scene"]:
        """`usable`: a scene can be made, and would be better if recorded differently."""
        if any(finding.prevents for finding in self.findings):
            return "no scene"
        return "usable" if self.findings else "good"

    @property
    def text(self) -> str:
        """The level and each finding with its remedy, a line each."""
        lines = {
            "good": "good: train on it",
            "usable": "usable, and better if recorded differently",
            "no scene": "no scene can be made of this",
        }
        return "\n".join([lines[self.level], *(f"{each.problem}: {each.remedy}" for each in self.findings)])


def judge_frames(measures: Measures) -> Verdict:
    """The verdict on frames before poses are sought."""
    return Verdict(tuple(_of_frames(measures)))


def judge(measures: Measures) -> Verdict:
    """The verdict on frames and poses. What prevents a scene stands alone, as the rest follows from it."""
    prevented = [*_of_frames(measures), *_without_parallax(measures)]
    prevented = [finding for finding in prevented if finding.prevents] or [*_without_poses(measures)]
    return Verdict(tuple(prevented[:1] or [*_of_frames(measures), *_improvable(measures)]))


def _of_frames(measures: Measures) -> Iterator[Finding]:
    if measures.black > MAX_BLACK:
        yield Finding(
            f"{measures.black:.0%} of the recording is black",
            "look at the recording; is a lens covered?",
            prevents=True,
        )
    elif measures.frames < MIN_FRAMES:
        recorded = f"of {measures.available} in the recording"
        yield Finding(
            f"{measures.frames} frames, {recorded}, are too few", f"record for longer; {MIN_FRAMES} are the least", True
        )
    elif measures.frames < FEW_FRAMES:
        yield Finding(
            f"{measures.frames} frames are few", "record for longer, or give a larger --frames; 100 are good", False
        )
    intervals = measures.frames + measures.blurred
    if measures.blurred > MUCH_BLURRED * intervals:
        blurred = f"in {measures.blurred} of {intervals} intervals of time all frames are blurred"
        yield Finding(blurred, "move slower, or use more light and a shorter exposure", prevents=False)


def _without_parallax(measures: Measures) -> Iterator[Finding]:
    if measures.cameras == measures.fixed == 1:
        yield Finding("the camera stands still, and one fixed camera can't give a scene", MOVE, prevents=True)
    elif measures.fixed == 0 and measures.beyond_rotation > 0 and _only_turned(measures):
        turned = f"all but {measures.beyond_rotation:.1f} pixels of the motion in its pictures is a rotation"
        yield Finding(f"the camera only turns on the spot: {turned}", MOVE, prevents=True)


def _only_turned(measures: Measures) -> bool:
    return measures.beyond_rotation < max(MIN_BEYOND_ROTATION * measures.size, LEAST_PIXELS)


def _without_poses(measures: Measures) -> Iterator[Finding]:
    share = measures.registered / measures.frames
    if share < MIN_WHOLE and measures.breaks:
        seconds = ", ".join(f"{second:.1f}" for second in measures.breaks)
        found = f"poses break off at {seconds} s, as at a cut, and join only one side"
        yield Finding(found, "split the recording there, and take one part, or record in one take", prevents=True)
    elif share < MIN_REGISTERED and measures.moving > MUCH_MOVING:
        yield Finding(f"{measures.moving:.0%} of the image moves", "keep more of what stands still in view", True)
    elif share < MIN_REGISTERED:
        found = f"poses are found for {measures.registered} of {measures.frames} frames"
        yield Finding(found, CLOSER if measures.fixed else TEXTURE, prevents=True)
    elif measures.seen < MIN_SEEN:
        yield Finding(f"a frame sees {measures.seen:.0f} points that poses agree on, which is too few", TEXTURE, True)
    elif measures.fixed < measures.cameras and measures.agreement < MIN_AGREEMENT:
        few = f"poses agree with {measures.agreement:.0%} of what frames have in common, so that they are wrong"
        yield Finding(few, "keep more of what stands still in view, and move slower", prevents=True)
    elif measures.parallax < MIN_PARALLAX:
        yield Finding(f"the parallax of {measures.parallax:.1f}° is too little", MOVE, prevents=True)


def _improvable(measures: Measures) -> Iterator[Finding]:
    if measures.registered < FEW_REGISTERED * measures.frames:
        found = f"poses are found for {measures.registered} of {measures.frames} frames; the others are left out"
        yield Finding(found, CLOSER if measures.fixed else TEXTURE, prevents=False)
    if measures.cameras == measures.fixed < ENOUGH_FIXED:
        few = f"poses of {measures.fixed} cameras that stand still are rough"
        yield Finding(few, f"use {ENOUGH_FIXED} cameras or more, or let one move", prevents=False)
    if measures.parallax < LITTLE_PARALLAX:
        yield Finding(f"the parallax of {measures.parallax:.1f}° is little", MOVE, prevents=False)
    if measures.reprojection_error > LARGE_ERROR:
        error = f"the reprojection error of {measures.reprojection_error:.1f} pixels is large"
        yield Finding(error, "use a shorter exposure, no zoom and no image stabilization", prevents=False)
    if measures.moving > MUCH_MOVING:
        moving = f"{measures.moving:.0%} of the image moves"
        yield Finding(moving, "keep more of what stands still in view", prevents=False)

"""Times of a dataset's images as `DataConfig.time_from` says, and warnings about those that can't be right."""

import re
from collections import Counter
from collections.abc import Hashable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

from msdgs_serve.scene import InvalidInput
from msdgs_train.datasets.common.name_fields import natural_order
from msdgs_train.datasets.common.name_times import (
    NameWithoutTime,
    Reading,
    readings,
    time_group,
    times_by_pattern,
    times_in_order,
)
from msdgs_train.datasets.common.readers import DatasetInvalid
from msdgs_train.datasets.common.scene_data import Frame, SceneData

NAMES, INDEX, NONE = "names", "index", "none"
EXPECTED = f"{NAMES}, {INDEX}, {NONE} or a regular expression with one group, or with one named `time`"
OTHERS = (
    f"--time-from {INDEX} takes the order of the names, --time-from {NONE} is for a scene that stands still, and a "
    "regular expression has the time as its group, as --time-from 'frame_(\\d+)'"
)
MIN_TIMES = 4
"""Fewer different times aren't searched for one that is far from the others."""


def is_time_from(value: object) -> bool:
    """Whether a value is a setting of `DataConfig.time_from`."""
    if value is None or value in (NAMES, INDEX, NONE):
        return True
    try:
        return isinstance(value, str) and time_group(re.compile(value)) is not None
    except re.error:
        return False


def timed(scene: SceneData, folder: Path, time_from: str | None) -> SceneData:
    """The scene with times from where `time_from` says, those of the dataset if None, and with warnings about them.

    Raises `DatasetInvalid` if names are ambiguous or lack a time, and `InvalidInput` for another `time_from`.
    """
    if not is_time_from(time_from):
        raise InvalidInput("time_from", EXPECTED, time_from)
    if time_from == NONE:
        return scene.retimed(lambda frame: 0.0)
    warnings = []
    if time_from is not None:
        times, warnings = _from_names(_frames(scene), folder, time_from)
        scene = scene.retimed(lambda frame: times[frame.image_path])
    return replace(scene, warnings=(*scene.warnings, *warnings, *time_warnings(_frames(scene))))


def time_warnings(frames: list[Frame]) -> list[str]:
    """What is unlikely about the times of a dataset, each a sentence with its remedy."""
    times = sorted({frame.t for frame in frames})
    if len(times) == 1:
        return [_equal(frames)] if len(frames) > 1 else []
    return [*_repeated(frames), *_outlying(frames, times)]


def _frames(scene: SceneData) -> list[Frame]:
    return scene.unsplit or [frame for frames in scene.splits.values() for frame in frames]


def _from_names(frames: list[Frame], folder: Path, time_from: str) -> tuple[dict[Path, float], list[str]]:
    """The time of each image in [0, 1], by its file, and warnings."""
    paths = [frame.image_path for frame in frames]
    names = [(path.relative_to(folder) if path.is_relative_to(folder) else path).as_posix() for path in paths]
    warnings = []
    try:
        if time_from == INDEX:
            times = times_in_order(names)
        elif time_from == NAMES:
            reading = _only_reading(names, frames, folder)
            times = reading.times if reading else (0,) * len(names)
            is_photo = reading is not None and reading.called == "photo" and min(reading.times) > 1
            warnings = [_photos(reading)] if reading and is_photo else []  # frames of a video begin at 0 or 1
        else:
            times = times_by_pattern(names, re.compile(time_from))
    except NameWithoutTime as error:
        problem = "has no number that gives its time" if time_from == NAMES else f"has no time where '{time_from}' says"
        raise DatasetInvalid(folder, error.args[0], f"{problem}; {OTHERS}") from None
    first, last = min(times), max(times)
    unit = [float((time - first) / ((last - first) or 1)) for time in times]
    return dict(zip(paths, unit, strict=True)), warnings


def _only_reading(names: list[str], frames: list[Frame], folder: Path) -> Reading | None:
    """The numbers that are the times; None if all names have the same numbers."""
    found = readings(names, [_pose(frame) for frame in frames], [_lens(frame) for frame in frames])
    if len(found) > 1:
        problem = f"have several numbers that may be the time: {_examples(names, found)}"
        raise DatasetInvalid(folder, "names of images", f"{problem}; {OTHERS}")
    if found and found[0].called == "camera":
        problem = f"have the number of a camera, but none of a time: {_examples(names, found)}"
        raise DatasetInvalid(folder, "names of images", f"{problem}; {OTHERS}")
    return found[0] if found else None


def _examples(names: list[str], found: list[Reading]) -> str:
    """Three names, and the time of each in the readings."""
    order = sorted(range(len(names)), key=lambda i: natural_order(names[i]))
    shown = sorted({order[0], order[1], order[-1]}, key=order.index)
    read = []
    for reading in found:
        option = f" with --time-from '{reading.pattern}'" if reading.pattern else ""
        read.append(", ".join(reading.texts[i] for i in shown) + option)
    return f"{', '.join(names[i] for i in shown)} would be at {', or at '.join(read)}"


def _pose(frame: Frame) -> bytes:
    return frame.camera.camera_to_world.tobytes()


def _lens(frame: Frame) -> Hashable:
    camera = frame.camera
    return camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height, frame.distortion


def _equal(frames: list[Frame]) -> str:
    return (
        f"all {len(frames)} images have the same time, so the scene is trained as one that stands still: if it moves, "
        f"take the times from the files' names with --time-from {NAMES}, or from their order with --time-from {INDEX}"
    )


def _photos(reading: Reading) -> str:
    return (
        f"times are the numbers of photos, {reading.texts[0]} to {reading.texts[-1]}, whatever time passed "
        f"between them: choose --time-from {NONE} for a scene that stands still"
    )


def _repeated(frames: list[Frame]) -> list[str]:
    shots = Counter((_pose(frame), frame.t) for frame in frames)
    shot, count = shots.most_common(1)[0]
    if count == 1:
        return []
    copies = [frame.name for frame in frames if (_pose(frame), frame.t) == shot]
    warning = (
        f"{shots.total() - len(shots)} of {len(frames)} images have the pose and the time of another one, such as "
        f"{copies[0]} and {copies[1]}: remove copies, or choose other times with --time-from"
    )
    return [warning]


def _outlying(frames: list[Frame], times: list[float]) -> list[str]:
    """A gap of more than half of the time range."""
    length = times[-1] - times[0]
    gap = next(((one, two) for one, two in pairwise(times) if two - one > 0.5 * length), None)
    if gap is None or len(times) < MIN_TIMES:
        return []
    before, after = ([frame for frame in frames if (frame.t >= gap[1]) is late] for late in (False, True))
    few, many = sorted((before, after), key=len)
    others = [frame.t for frame in many]
    warning = (
        f"{len(few)} of {len(frames)} images, such as {few[0].name} at t = {few[0].t:g}, are far in time from the "
        f"others at t = {min(others):g} to {max(others):g}: remove them, correct their times, or choose other times "
        "with --time-from"
    )
    return [warning]

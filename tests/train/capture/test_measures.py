"""Figures of frames and poses agree with how they were made."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from msdgs_train.capture.measures import measure_frames, measure_poses
from msdgs_train.capture.poses import Poses
from msdgs_train.capture.rotation import Pair, beyond_rotation
from msdgs_train.capture.verdict import MIN_BEYOND_ROTATION
from tests.support.camera_moves import DISTANCE, TARGET, arc, pan
from tests.train.capture.made_capture import made_frames, made_model, made_poses


def test_frames_are_counted():
    measures = measure_frames(made_frames(30, blurred=4, black=9, repeated=7, cuts=(1.2,)))
    assert (measures.frames, measures.available, measures.blurred, measures.repeated) == (30, 90, 4, 7)
    assert (measures.black, measures.cuts, measures.seconds) == (0.1, (1.2,), 2.9)


def test_an_arc_is_measured():
    frames = made_frames()
    measures = measure_poses(measure_frames(frames), frames, made_poses(made_model(frames)), {"a": 0.1, "b": 0.3})
    assert (measures.registered, measures.fixed, measures.points, measures.other_models) == (16, 0, 200, (5, 3))
    assert measures.moving == pytest.approx(0.2)
    chord = 2 * DISTANCE * np.cos(np.radians(17)) * np.sin(np.radians(20))
    assert measures.baseline == pytest.approx(chord / DISTANCE, rel=0.1)
    assert measures.parallax == pytest.approx(30, abs=8)
    assert len(measures.parallax_of_frames) == 16
    assert (measures.beyond_rotation, measures.seen, measures.size) == (7.5, 200, 96)


def pairs_of(camera_to_world: list[np.ndarray], focal: float, moving: int = 0) -> list[Pair]:
    """Exact matches of 150 points of all depths between the first frame and each other one, of which some move."""
    random = np.random.default_rng(0)
    points = TARGET + random.uniform(-0.7, 0.7, (150, 3))
    places = []
    for index, pose in enumerate(camera_to_world):
        local = (points + (np.arange(150) < moving)[:, None] * [0.02 * index, 0, 0] - pose[:3, 3]) @ pose[:3, :3]
        places.append(focal * local[:, :2] / local[:, 2:])
    return [Pair(places[0], place) for place in places[1:]]


@pytest.mark.parametrize("focal", [0.6, 1.0, 2.2])
@pytest.mark.parametrize("moving", [0, 30])
def test_nothing_of_a_pan_is_beyond_a_rotation_whatever_the_lens(focal: float, moving: int):
    assert beyond_rotation(pairs_of(pan(20, 9), focal, moving)) < MIN_BEYOND_ROTATION


@pytest.mark.parametrize("moving", [0, 30])
def test_an_arc_is_beyond_a_rotation_by_its_parallax(moving: int):
    found = [beyond_rotation(pairs_of(arc(degrees, 9), 1.0, moving)) for degrees in (0.001, 5, 10, 20)]
    assert found[1] > 0.005
    assert found == sorted(found)


def test_without_pairs_nothing_is_known():
    assert beyond_rotation([]) == 0


@pytest.mark.parametrize(
    ("without", "breaks"),
    [
        (range(8, 16), (0.8,)),
        ([3, 9], ()),
        (range(4), (0.4,)),
        (range(5, 10), (0.5, 1.0)),
        ([0, *range(8, 16)], (0.8,)),
    ],
)
def test_poses_break_off_where_long_stretches_meet(without: Sequence[int], breaks: tuple[float, ...]):
    frames = made_frames()
    model = made_model(frames)
    kept = np.array([row for row in range(16) if row not in set(without)])
    rows = {int(old): new for new, old in enumerate(kept)}
    seen = np.array([(rows[image], point) for image, point in model.observations.tolist() if image in rows])
    fewer = {"names": model.names[kept], "camera_to_world": model.camera_to_world[kept]}
    model = type(model)(**{**vars(model), **fewer, "intrinsics": model.intrinsics[kept], "observations": seen})
    assert measure_poses(measure_frames(frames), frames, made_poses(model), {}).breaks == breaks


def test_frames_of_a_fixed_camera_have_the_figures_of_its_background():
    """COLMAP matches only the background, under the name of one of the frames."""
    frames = made_frames()
    model = made_model(frames)
    only = type(model)(**{**vars(model), "observations": model.observations[model.observations[:, 0] == 5]})
    fixed = measure_poses(measure_frames(frames), frames, Poses(Path("sparse"), only, (True,)), {})
    moving = measure_poses(measure_frames(frames), frames, made_poses(only), {})
    assert (fixed.seen, moving.seen) == (200, 0)
    assert len(set(fixed.parallax_of_frames)) == 1


def test_two_captures_of_one_arc_measure_the_same_in_any_unit():
    frames = made_frames()
    model = made_model(frames, arc(20, 16))
    poses = model.camera_to_world.copy()
    poses[:, :3, 3] *= 7
    larger = type(model)(**{**vars(model), "camera_to_world": poses, "points": 7 * model.points})
    one, other = (measure_poses(measure_frames(frames), frames, made_poses(each), {}) for each in (model, larger))
    assert other.parallax_of_frames == pytest.approx(one.parallax_of_frames)
    assert other.baseline == pytest.approx(one.baseline)

"""Figures of frames and poses agree with how they were made."""

import numpy as np
import pytest

from msdgs_train.capture.measures import measure_frames, measure_poses
from msdgs_train.capture.rotation import Pair, rotation_residual
from tests.support.camera_moves import DISTANCE, arc, pan
from tests.train.capture.made_capture import FOCAL, made_frames, made_model, made_poses


def test_frames_are_counted():
    measures = measure_frames(made_frames(30, blurred=4, black=10, repeated=7, cuts=(1.2,)))
    assert (measures.frames, measures.available, measures.blurred, measures.repeated) == (30, 90, 4, 7)
    assert (measures.black, measures.cuts, measures.seconds) == (0.25, (1.2,), 2.9)


def test_an_arc_is_measured():
    frames = made_frames()
    measures = measure_poses(measure_frames(frames), frames, made_poses(made_model(frames)), {"a": 0.1, "b": 0.3})
    assert (measures.registered, measures.fixed, measures.points, measures.other_models) == (16, 0, 200, (5, 3))
    assert measures.moving == pytest.approx(0.2)
    chord = 2 * DISTANCE * np.cos(np.radians(17)) * np.sin(np.radians(20))
    assert measures.baseline == pytest.approx(chord / DISTANCE, rel=0.1)
    assert measures.parallax == pytest.approx(30, abs=8)
    assert len(measures.parallax_of_frames) == 16
    assert measures.beyond_rotation > 5


@pytest.mark.parametrize("degrees", [20, 60])
def test_nothing_of_a_pan_is_beyond_a_rotation(degrees: float):
    frames = made_frames()
    poses = made_poses(made_model(frames, pan(degrees, 16)))
    assert measure_poses(measure_frames(frames), frames, poses, {}).beyond_rotation < 0.01


@pytest.mark.parametrize("scale", [0.8, 1.25])
def test_a_pan_with_a_wrong_focal_length_and_moved_centers_is_still_one(scale: float):
    """As COLMAP finds it: depths that make up for centers that never moved."""
    random, frames = np.random.default_rng(0), made_frames()
    model = made_model(frames, pan(40, 16))
    pair_points = random.uniform(-30, 30, (100, 2))
    rays = np.concatenate([pair_points, np.full((100, 1), FOCAL)], axis=1)
    turn = model.camera_to_world[8, :3, :3].T @ model.camera_to_world[0, :3, :3]
    turned = rays @ turn.T
    pair = Pair(pair_points, FOCAL * turned[:, :2] / turned[:, 2:], scale * FOCAL)
    assert rotation_residual(pair, FOCAL) < 1e-6
    assert rotation_residual(pair, scale * FOCAL) > 0.1


def test_what_moves_does_not_hide_that_the_rest_only_turns():
    random = np.random.default_rng(0)
    first = random.uniform(-40, 40, (100, 2))
    second = first.copy()
    second[:20] += 15
    assert rotation_residual(Pair(first, second, FOCAL), FOCAL) < 0.2


@pytest.mark.parametrize(
    ("cuts", "without", "apart"),
    [((0.8,), range(8, 16), (0.8,)), ((0.8,), [3, 9], ()), ((0.4, 1.0), range(4), (0.4,)), ((), range(8), ())],
)
def test_cuts_with_poses_on_one_side_only(cuts: tuple[float, ...], without: list[int], apart: tuple[float, ...]):
    frames = made_frames(cuts=cuts)
    model = made_model(frames)
    kept = np.array([row for row in range(16) if row not in set(without)])
    rows = {int(old): new for new, old in enumerate(kept)}
    seen = np.array([(rows[image], point) for image, point in model.observations.tolist() if image in rows])
    fewer = {"names": model.names[kept], "camera_to_world": model.camera_to_world[kept]}
    model = type(model)(**{**vars(model), **fewer, "intrinsics": model.intrinsics[kept], "observations": seen})
    assert measure_poses(measure_frames(frames), frames, made_poses(model), {}).cut_apart == apart


def test_two_captures_of_one_arc_measure_the_same_in_any_unit():
    frames = made_frames()
    model = made_model(frames, arc(20, 16))
    poses = model.camera_to_world.copy()
    poses[:, :3, 3] *= 7
    larger = type(model)(**{**vars(model), "camera_to_world": poses, "points": 7 * model.points})
    one, other = (measure_poses(measure_frames(frames), frames, made_poses(each), {}) for each in (model, larger))
    assert other.parallax_of_frames == pytest.approx(one.parallax_of_frames)
    assert other.baseline == pytest.approx(one.baseline)
    assert other.beyond_rotation == pytest.approx(one.beyond_rotation)

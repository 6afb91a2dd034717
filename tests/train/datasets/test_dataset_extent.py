"""How large a scene is taken to be when its dataset doesn't say."""

import numpy as np
import pytest

from msdgs_serve.scene import Camera
from msdgs_serve.scene.camera import look_at
from msdgs_train.datasets.common.extent import scene_half_size
from tests.support.tolerances import assert_close

UP = np.array([0.0, 0.0, 1.0])


def cameras_around(target: tuple[float, float, float], distance: float, count: int = 12) -> list[Camera]:
    """On a ring, all looking at the target from the same height above it."""
    poses = []
    for angle in np.linspace(0, 2 * np.pi, count, endpoint=False):
        eye = target + distance * np.array([0.8 * np.cos(angle), 0.8 * np.sin(angle), 0.6])
        poses.append(look_at(eye, np.array(target), UP))
    return [Camera.from_fov(pose, 20, 10, 40.0) for pose in poses]


def test_few_points_that_are_far_off_count_for_nothing():
    points = np.random.default_rng(0).uniform(-1, 1, size=(1000, 3))
    clean = scene_half_size(points, cameras_around((0, 0, 0), 4.0))
    points[:5] *= 1e6
    assert 0.9 < clean < scene_half_size(points, []) < 1.0


def test_without_points_it_is_the_distance_to_where_all_cameras_look():
    assert_close(scene_half_size(None, cameras_around((0, 0, 0), 4.0)), 4.0, "rotation")
    assert_close(scene_half_size(np.empty((0, 3)), cameras_around((3, -5, 1), 4.0)), 9.0, "rotation")


@pytest.mark.parametrize("count", [1, 3])
def test_parallel_axes_meet_nowhere(count: int):
    poses = [np.eye(4) for _ in range(count)]
    for index, pose in enumerate(poses):
        pose[:3, 3] = [2.0 * index, 0, 0]
    extent = scene_half_size(None, [Camera.from_fov(pose, 20, 10, 40.0) for pose in poses])
    assert extent == (4.0 if count == 3 else 1.0)

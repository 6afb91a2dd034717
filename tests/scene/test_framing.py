"""The default view of a scene, derived from its cameras or its bounds."""

import numpy as np
import pytest

from msdgs_serve.framing import framing
from msdgs_serve.scene import Camera
from msdgs_serve.scene.baked import SceneCamera, SceneMetadata
from msdgs_serve.scene.camera import orbit
from tests.support.scene_files import metadata
from tests.support.tolerances import assert_close

UP = np.array([0.0, 0.0, 1.0])
PIVOT = np.array([0.5, -0.25, 0.75])  # on the grid that targets are rounded to
FAR_OUT = ((-1.0, -1.0, -1.0), (1.0, 9.0, 7.0))


def seen_by(*poses: np.ndarray) -> SceneMetadata:
    """A scene with cameras of these poses, [4, 4], and bounds whose middle is beside what they look at."""
    cameras = tuple(SceneCamera(str(i), 0.0, Camera.from_fov(pose, 64, 48, 40.0)) for i, pose in enumerate(poses))
    return metadata(cameras=cameras, bounds=FAR_OUT)


def test_the_target_is_what_the_cameras_look_at():
    seen = framing(seen_by(*(orbit(PIVOT, 4.0, azimuth, 20, UP) for azimuth in (0, 70, 200))))
    assert_close(seen.target, PIVOT, "rotation")
    assert_close(seen.distance, 4.0, "rotation")


@pytest.mark.parametrize("sideways", [0.0, 0.3])
def test_cameras_side_by_side_leave_the_middle_of_the_bounds(sideways: float):
    ahead = orbit(PIVOT, 4.0, 0, 20, UP)
    beside = ahead.copy()
    beside[:3, 3] += sideways * ahead[:3, 0]
    assert_close(framing(seen_by(ahead, beside)).target, [0, 4, 3], "rotation")


def test_cameras_that_look_away_from_each_other_leave_the_middle_of_the_bounds():
    poses = [orbit(PIVOT, 0.1, azimuth, 20, UP) @ np.diag([-1.0, 1.0, -1.0, 1.0]) for azimuth in (0, 70, 200)]
    assert_close(framing(seen_by(*poses)).target, [0, 4, 3], "rotation")

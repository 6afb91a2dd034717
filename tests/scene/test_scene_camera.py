"""Cameras project points to known pixels, invalid ones are refused, and the default view of a scene."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from msdgs_serve.client import Matrix, request_body
from msdgs_serve.framing import framing
from msdgs_serve.scene import Camera, InvalidInput
from msdgs_serve.scene.baked import SceneCamera, SceneMetadata
from msdgs_serve.scene.camera import look_at, orbit
from tests.support.scene_files import UP, metadata
from tests.support.scenes import pixel_of, random_camera
from tests.support.tolerances import assert_close


def test_identity_pose_is_opencv():
    camera = Camera(100.0, 200.0, 50.0, 40.0, 100, 80, np.eye(4))
    assert_close(pixel_of(camera, [0, 0, 5]), [50, 40], "pixel")
    assert_close(pixel_of(camera, [1, 0, 5]), [70, 40], "pixel")  # x: right
    assert_close(pixel_of(camera, [0, 1, 5]), [50, 80], "pixel")  # y: down


def test_points_outside_of_the_image_have_no_visible_depth():
    camera = Camera(100.0, 200.0, 50.0, 40.0, 100, 80, np.eye(4))
    points = [[0, 0, 5], [-2.5, 0, 5], [2.5, 0, 5], [0, -1, 5], [0, 1, 5], [0, 0, -5], [0, 0, 0], [math.nan, 0, 5]]
    assert camera.visible_depths(np.array(points)).tolist() == [5, 5, 0, 5, 0, 0, 0, 0]


def test_world_to_camera_is_the_inverse():
    camera = random_camera(np.random.default_rng(0), 53, 37)
    assert_close(camera.world_to_camera @ camera.camera_to_world, np.eye(4), "rotation")
    assert_close(camera.world_to_camera @ [*camera.position, 1], [0, 0, 0, 1], "rotation")


@pytest.mark.parametrize("fov_y", [1.0, 45.0, 90.0, 170.0])
def test_from_fov_sees_that_angle(fov_y: float):
    camera = Camera.from_fov(np.eye(4), 200, 100, fov_y)
    half = math.tan(math.radians(fov_y / 2))
    assert_close(pixel_of(camera, [0, half, 1]), [100, 100], "pixel")
    assert_close(pixel_of(camera, [-2 * half, -half, 1]), [0, 0], "pixel")


def test_from_look_at_centres_the_target_with_up_upwards():
    eye, target, up = np.array([3.0, -2, 1]), np.array([0.5, 0.2, -0.1]), np.array([0.0, 0, 1])
    camera = Camera.from_look_at(eye, target, up, 80, 60, 50.0)
    assert_close(camera.position, eye, "rotation")
    assert_close(pixel_of(camera, target), [40, 30], "pixel")
    above = pixel_of(camera, target + 0.1 * up)
    assert_close(above[0], 40, "pixel")
    assert above[1] < 30
    right = np.cross(target - eye, up)
    assert pixel_of(camera, target + 0.1 * right)[0] > 40


def test_from_opengl_looks_along_minus_z_with_y_up():
    camera = Camera.from_opengl(np.eye(4), 80, 60, fx=50, fy=50, cx=40, cy=30)
    assert_close(pixel_of(camera, [0, 0, -2]), [40, 30], "pixel")
    assert_close(pixel_of(camera, [1, 0, -2]), [65, 30], "pixel")
    assert_close(pixel_of(camera, [0, 1, -2]), [40, 5], "pixel")


@pytest.mark.parametrize("up", [[0.0, 0, 1], [0.0, -1, 0], [1.0, 2, 3]])
def test_orbit_keeps_distance_and_elevation(up: list[float]):
    target, direction = np.array([0.3, -0.2, 0.5]), np.array(up) / np.linalg.norm(up)
    for azimuth in (0.0, 90.0, 215.0):
        pose = orbit(target, 4.0, azimuth, 30.0, np.array(up))
        offset = pose[:3, 3] - target
        assert_close(np.linalg.norm(offset), 4, "rotation")
        assert_close(offset @ direction, 4 * math.sin(math.radians(30)), "rotation")
        camera = Camera.from_fov(pose, 64, 64, 40.0)
        assert_close(pixel_of(camera, target), [32, 32], "pixel")
        assert pixel_of(camera, target + 0.1 * direction)[1] < 32


def test_orbit_by_azimuth_is_a_rotation_around_up():
    up, origin = np.array([0.0, 0, 1]), np.zeros(3)
    start, quarter = (orbit(origin, 2.0, azimuth, 20.0, up) for azimuth in (10.0, 100.0))
    rotation = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    assert_close(quarter[:3], rotation @ start[:3], "rotation")


def test_resized_camera_sees_the_same_in_proportion():
    camera = random_camera(np.random.default_rng(1), 80, 60)
    point = camera.position + 3 * camera.camera_to_world[:3, 2] + [0.1, 0.2, -0.1]
    resized = camera.resized(160, 30)
    assert (resized.width, resized.height) == (160, 30)
    assert_close(pixel_of(resized, point), pixel_of(camera, point) * [2, 0.5], "pixel")


GOOD = {"fx": 50.0, "fy": 50.0, "cx": 20.0, "cy": 15.0, "width": 40, "height": 30, "camera_to_world": np.eye(4)}


@pytest.mark.parametrize(
    ("field", "poison"),
    [
        *((name, value) for name in ("fx", "fy") for value in (0.0, -1.0, math.nan, math.inf)),
        *((name, value) for name in ("cx", "cy") for value in (math.nan, -math.inf)),
        *((name, value) for name in ("width", "height") for value in (0, -3, 1.5, 10**9, math.nan, "40")),
        ("camera_to_world", np.eye(3)),
        ("camera_to_world", np.full((4, 4), np.nan)),
        ("camera_to_world", np.zeros((4, 4))),
        ("camera_to_world", np.diag([2.0, 2, 2, 1])),
        ("camera_to_world", np.diag([1.0, 1, -1, 1])),
        ("camera_to_world", np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 1, 1]])),
        ("model", "panorama"),
        ("distortion", (0.1, 0, 0, 0)),
        *(("distortion", {"model": "fisheye", "distortion": k}) for k in ((0.1, 0.2), (0.1, 0.2, 0, math.nan))),
    ],
)
def test_poison_is_refused_by_name(field: str, poison: object):
    changes = poison if isinstance(poison, dict) else {field: poison}
    with pytest.raises(InvalidInput, match=rf"`camera\.{field}` must be .*, got ") as error:
        Camera(**{**GOOD, **changes})  # pyright: ignore[reportArgumentType]
    assert error.value.field == f"camera.{field}"


ORIGIN, Z = [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]


@pytest.mark.parametrize(
    ("field", "made", "arguments"),
    [
        *(("fov_y", Camera.from_fov, (np.eye(4), 40, 30, fov_y)) for fov_y in (0.0, 180.0, -10.0, 190.0, math.nan)),
        ("target", look_at, ([1, 2, 3], [1, 2, 3], Z)),
        ("up", look_at, ([0, 0, 3], ORIGIN, Z)),
        ("up", look_at, ([0, 0, 3], ORIGIN, ORIGIN)),
        ("eye", look_at, ([0, 0, math.nan], ORIGIN, Z)),
        ("target", look_at, ([0, 0, 3], [math.inf, 0, 0], [0, 1, 0])),
        ("up", look_at, ([0, 0, 3], ORIGIN, [1, 0])),
        ("distance", orbit, (ORIGIN, 0.0, 0.0, 0.0, Z)),
        ("distance", orbit, (ORIGIN, math.inf, 0.0, 0.0, Z)),
        ("azimuth", orbit, (ORIGIN, 1.0, math.nan, 0.0, Z)),
        ("elevation", orbit, (ORIGIN, 1.0, 0.0, 90.0, Z)),
        ("elevation", orbit, (ORIGIN, 1.0, 0.0, math.nan, Z)),
        ("up", orbit, (ORIGIN, 1.0, 0.0, 0.0, ORIGIN)),
    ],
)
def test_views_that_cannot_be_are_refused_by_name(field: str, made: Callable[..., object], arguments: tuple[Any, ...]):
    with pytest.raises(InvalidInput, match=rf"`camera\.{field}` must be ") as error:
        made(*(np.array(value, float) if isinstance(value, list) else value for value in arguments))
    assert error.value.field == f"camera.{field}"


def test_pose_can_not_be_changed_from_outside():
    pose = np.eye(4)
    camera = Camera(**{**GOOD, "camera_to_world": pose})
    pose[0, 3] = 7
    assert camera.position[0] == 0
    with pytest.raises(ValueError, match="read-only"):
        camera.camera_to_world[0, 3] = 7


@pytest.mark.parametrize("shape", [(4,), (4, 1), (1, 4)])
def test_distortion_is_taken_as_opencv_returns_it(shape: tuple[int, ...]):
    numbers = 0.1, -0.02, 0.003, -0.0004
    given: Any = np.reshape(numbers, shape)
    camera = Camera(10.0, 10.0, 4.0, 3.0, 8, 6, np.eye(4), "fisheye", given)
    assert camera.distortion == numbers
    assert Camera(10.0, 10.0, 4.0, 3.0, 8, 6, np.eye(4), distortion=0 * given).distortion == (0.0,) * 4
    sent = request_body(Matrix(np.eye(4), fx=10, model="fisheye", distortion=given), 0.0)["camera"]
    assert sent["distortion"] == list(numbers)


def test_an_image_of_other_proportions_shows_more_or_less_at_its_sides():
    camera = Camera(10.0, 12.0, 5.0, 3.0, 8, 6, np.eye(4))
    wide, narrow = camera.of_size(32, 12), camera.of_size(4, 6)
    assert (wide.fx, wide.fy, wide.cx, wide.cy) == (20.0, 24.0, 18.0, 6.0)
    assert (narrow.fx, narrow.fy, narrow.cx, narrow.cy) == (10.0, 12.0, 3.0, 3.0)
    for width, height in ((16, 12), (17, 13), (801, 600)):
        alike, resized = camera.of_size(width, height), camera.resized(width, height)
        assert (alike.fx, alike.fy, alike.cx, alike.cy) == (resized.fx, resized.fy, resized.cx, resized.cy)


def test_a_resized_camera_keeps_its_model():
    camera = Camera(10.0, 12.0, 4.0, 3.0, 8, 6, np.eye(4), "fisheye", (0.1, 0.0, 0.0, 0.0)).resized(16, 12)
    assert (camera.model, camera.distortion) == ("fisheye", (0.1, 0.0, 0.0, 0.0))
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (20, 24, 8, 6)


CENTER = np.array([0.5, -0.25, 0.75])  # a multiple of the rounding of targets
FAR_OUT = ((-1.0, -1.0, -1.0), (1.0, 9.0, 7.0))


def seen_by(*poses: np.ndarray) -> SceneMetadata:
    """A scene with cameras of these poses, [4, 4], which don't look at the center of its bounds."""
    cameras = tuple(SceneCamera(str(i), 0.0, Camera.from_fov(pose, 64, 48, 40.0)) for i, pose in enumerate(poses))
    return metadata(cameras=cameras, bounds=FAR_OUT)


def test_the_target_is_what_the_cameras_look_at():
    seen = framing(seen_by(*(orbit(CENTER, 4.0, azimuth, 20, UP) for azimuth in (0, 70, 200))))
    assert_close(seen.target, CENTER, "rotation")
    assert_close(seen.distance, 4.0, "rotation")


@pytest.mark.parametrize("sideways", [0.0, 0.3])
def test_cameras_side_by_side_leave_the_middle_of_the_bounds(sideways: float):
    ahead = orbit(CENTER, 4.0, 0, 20, UP)
    beside = ahead.copy()
    beside[:3, 3] += sideways * ahead[:3, 0]
    assert_close(framing(seen_by(ahead, beside)).target, [0, 4, 3], "rotation")


def test_cameras_that_look_away_from_each_other_leave_the_middle_of_the_bounds():
    poses = [orbit(CENTER, 0.1, azimuth, 20, UP) @ np.diag([-1.0, 1.0, -1.0, 1.0]) for azimuth in (0, 70, 200)]
    assert_close(framing(seen_by(*poses)).target, [0, 4, 3], "rotation")


@pytest.mark.parametrize("up", [(0.1, -0.9, 0.3), (0.0, 0.05, 1.0), (0.0, 0.0, -1.0)])
def test_level_cameras_that_look_around_say_exactly_what_is_up(up: tuple[float, ...]):
    unit = np.array(up) / np.linalg.norm(up)
    poses = [orbit(CENTER, 4.0, azimuth, 20, unit) for azimuth in (0, 70, 200)]
    assert_close(framing(seen_by(*poses)).up, unit, "rotation")
    assert np.array_equal(np.abs(framing(seen_by(*poses)).up), (0, 0, 1)) == (max(abs(unit)) == 1)


def test_a_single_camera_that_looks_down_means_the_axis_close_to_its_up():
    assert_close(framing(seen_by(orbit(CENTER, 4.0, 30, 30, UP))).up, UP, "rotation")


def test_rotations_may_be_rounded_to_three_decimals():
    matrix = np.eye(4)
    for rotation in Rotation.random(200, rng=np.random.default_rng(0)).as_matrix():
        matrix[:3, :3] = rotation.round(3)
        Camera(4, 4, 2.0, 2.0, 4, 4, matrix)
    for scale in (0.998, 1.002):
        matrix[:3, :3] = scale * np.eye(3)
        with pytest.raises(InvalidInput, match="without scale"):
            Camera(4, 4, 2.0, 2.0, 4, 4, matrix)

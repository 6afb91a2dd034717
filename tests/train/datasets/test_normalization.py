"""A scene is trained in a frame near the origin, whatever units and origin its files have."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from msdgs_serve.scene import Camera
from msdgs_serve.scene.camera import look_at, orbit
from msdgs_serve.scene.similarity import IDENTITY, Similarity
from msdgs_train.datasets import Frame, SceneData
from msdgs_train.datasets.common.extent import scene_half_size
from msdgs_train.datasets.common.normalization import DISTANCE, KEPT_OFFSET, find_subject
from msdgs_train.datasets.common.summary import summary
from tests.support.tolerances import assert_close, tolerance

UP = np.array([0.0, 0.0, 1.0])
PLACES = {
    "metashape": Similarity(1.0, (100.0, 50.0, 0.0)),
    "survey": Similarity(1.0, (500_123.4, 5_200_456.7, 812.3)),
    "millimetres": Similarity(1000.0),
    "microscope": Similarity(0.001),
    "blender": Similarity(100.0),
    "everything": Similarity(37.0, (-4000.0, 20.0, 9000.0)),
}


def scene_of(poses: list[np.ndarray], points: np.ndarray | None = None, *, nominal: bool = False) -> SceneData:
    cameras = [Camera.from_fov(pose, 40, 30, 40.0) for pose in poses]
    frames = [Frame(f"{i}", camera, i / len(cameras), Path(f"{i}.png")) for i, camera in enumerate(cameras)]
    half_size = 1.3 if nominal else scene_half_size(points, cameras)
    return SceneData({"train": frames, "test": []}, half_size, points, layout="D-NeRF", has_nominal_size=nominal)


def around(distance: float = 4.0, elevation: float = 20.0) -> list[np.ndarray]:
    return [orbit(np.zeros(3), distance, azimuth, elevation, UP) for azimuth in range(0, 360, 30)]


def outwards(radius: float = 0.4) -> list[np.ndarray]:
    eyes = [radius * np.array([np.cos(a), np.sin(a), 0.1 * np.sin(3 * a)]) for a in np.linspace(0, 6, 20)]
    return [look_at(eye, 3 * eye, UP) for eye in eyes]


def forwards() -> list[np.ndarray]:
    """Parallel cameras beside each other, which look along y."""
    return [look_at(np.array([x, 0.0, 0.0]), np.array([x, 1.0, 0.0]), UP) for x in np.linspace(-0.5, 0.5, 9)]


POINTS = np.random.default_rng(0).uniform(-0.5, 0.5, (300, 3))
SCENES = {
    "around": scene_of(around()),
    "around, nominal": scene_of(around(), nominal=True),
    "around, points": scene_of(around(), POINTS),
    "outwards": scene_of(outwards()),
    "outwards, points": scene_of(outwards(), 5 * POINTS / np.linalg.norm(POINTS, axis=1, keepdims=True)),
    "forwards": scene_of(forwards()),
    "forwards, points": scene_of(forwards(), POINTS + np.array([0.0, 4.0, 0.0])),
}


def placed(scene: SceneData, place: Similarity) -> SceneData:
    """The same scene as files in another world would have it."""

    def moved(frame: Frame) -> Frame:
        return dataclasses.replace(frame, camera=place.camera_to_world(frame.camera))

    splits = {split: [moved(frame) for frame in frames] for split, frames in scene.splits.items()}
    points = None if scene.points is None else place.to_world(scene.points)
    return dataclasses.replace(scene, splits=splits, points=points)


@pytest.mark.parametrize("place", PLACES.values(), ids=PLACES)
@pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES)
def test_units_and_origin_of_the_files_have_no_effect(scene: SceneData, place: Similarity):
    got = placed(scene, place).normalized()
    center, distance, _ = find_subject(got.cameras, got.points)
    own = find_subject(scene.cameras, scene.points)
    kept = own.distance if place.scale == 1 else DISTANCE
    assert distance == pytest.approx(kept, rel=tolerance("normalized.scale"))
    far = np.linalg.norm(place.to_world(own.center)) > KEPT_OFFSET * place.scale * own.distance
    assert np.linalg.norm(center) < (tolerance("normalized.center") if far else KEPT_OFFSET * distance)
    assert len(got.warnings) == len(scene.normalized().warnings)
    if scene.has_nominal_size:
        assert got.scene_half_size == scene.scene_half_size
    else:
        centered = scene.in_frame(Similarity(1.0, tuple(own.center - center / distance * own.distance)))
        want = distance / own.distance * centered.scene_half_size
        assert got.scene_half_size == pytest.approx(want, rel=tolerance("normalized.center"))


@pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES)
def test_a_scene_of_the_right_size_at_the_origin_keeps_its_frame(scene: SceneData):
    center, distance, _ = find_subject(scene.cameras, scene.points)
    if np.linalg.norm(center) > 1:
        scene = placed(scene, Similarity(1.0, tuple(-center)))
    got = scene.normalized()
    assert 2 < distance < 8
    assert got.scene_to_world == IDENTITY
    assert got.splits == scene.splits


@pytest.mark.parametrize("place", PLACES.values(), ids=PLACES)
def test_the_files_world_is_kept(place: Similarity):
    scene = placed(SCENES["around, points"], place)
    trained = scene.normalized()
    assert trained.normalized() is trained
    back = trained.in_frame(IDENTITY)
    largest = np.abs(scene.points if scene.points is not None else 0).max()
    assert back.points is not None
    assert_close(back.points / largest, scene.points / largest, "placed")
    for one, other in zip(back.cameras, scene.cameras, strict=True):
        assert_close(one.position / largest, other.position / largest, "placed")
        np.testing.assert_array_equal(one.camera_to_world[:3, :3], other.camera_to_world[:3, :3])


def test_a_few_cameras_that_look_elsewhere_hardly_move_the_center():
    strays = [look_at(np.array([3.0, 1.0, 0.0]), np.array([9.0, -40.0, 8.0]), UP)] * 2
    assert np.abs(find_subject(scene_of([*around(), *strays]).cameras, None).center).max() < tolerance(
        "normalized.center"
    )


def test_cameras_that_look_outwards_have_what_they_show_around_them():
    scene = scene_of(outwards(0.01))
    assert scene.normalized().scene_half_size == pytest.approx(DISTANCE, rel=tolerance("normalized.center"))
    (warning,) = scene.normalized().warnings
    assert "--scene-half-size" in warning
    nominal = scene_of(outwards(0.01), nominal=True).normalized()
    assert nominal.scene_half_size > 3


def test_points_that_no_camera_sees_are_left_out_and_named():
    elsewhere = POINTS + np.array([0.0, 0.0, 90.0])
    scene = scene_of(around(), elsewhere).normalized()
    assert scene.points is None
    assert scene.scene_half_size == pytest.approx(4.0)
    (warning,) = scene.warnings
    assert "no camera sees one of the 300 points" in warning
    assert not scene_of(around(), POINTS).normalized().warnings


def test_points_that_few_cameras_see_are_left_out_and_counted():
    first = around()[0]
    seen_once = first[:3, 3] + 40 * first[:3, 2] + POINTS
    scene = scene_of([*around(), *around(5.0, -10.0)], seen_once).normalized()
    assert scene.points is None
    (warning,) = scene.warnings
    assert "cameras see one of the 300 points" in warning


@pytest.mark.parametrize(("factor", "problem"), [(1000, "look at what is 4 "), (0.001, "within 0.00")])
def test_points_in_other_units_than_the_poses_are_named(factor: float, problem: str):
    scene = scene_of(around(), factor * POINTS).normalized()
    (warning,) = scene.warnings
    assert problem in warning
    assert "units of the poses" in warning


@pytest.mark.parametrize("factor", [0.1, 1, 10])
def test_small_objects_and_wide_backgrounds_are_no_other_units(factor: float):
    assert not scene_of(around(), factor * POINTS).normalized().warnings


@pytest.mark.parametrize("count", [1, 5])
@pytest.mark.parametrize("place", [IDENTITY, PLACES["survey"]])
def test_one_pose_without_points_has_a_cube_of_a_unit_around_it(count: int, place: Similarity):
    fixed = placed(scene_of([look_at(np.array([1.9, 2.8, 2.1]), np.zeros(3), UP)] * count), place).normalized()
    (position,) = {tuple(camera.position) for camera in fixed.cameras}
    assert fixed.scene_half_size == pytest.approx(np.abs(position).max() + 1)


@pytest.mark.parametrize("place", [IDENTITY, PLACES["survey"]])
def test_cameras_at_one_place_are_named(place: Similarity):
    fixed = placed(scene_of([around()[0]] * 5), place).normalized()
    assert [warning for warning in fixed.warnings if "all cameras are at one place" in warning]
    assert not scene_of(around()[:1]).normalized().warnings


def test_one_line_says_what_was_read():
    scene = placed(SCENES["around, points"], PLACES["everything"]).normalized()
    assert summary(scene, (1.0, 0.5, 0.0)) == (
        "D-NeRF layout, 12 train images, 40×30, 12 camera poses, 12 times from 0 to 0.916667, 300 points, "
        "background #ff8000, trained at 0.027 times its size around (-4000, 20, 9000)"
    )
    assert summary(SCENES["outwards"], (1.0, 1.0, 1.0)).endswith("no points, background #ffffff")
